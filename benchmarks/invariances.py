"""Invariance of claims: campaigns are changed in irrelevant ways and analysed again.

    python benchmarks/invariances.py --list
    python benchmarks/invariances.py --out out/invariances.jsonl [--campaigns ripple drift]
                                     [--changes jitter_time_1e-6]

A campaign is changed (measured numbers jittered by 1e-6 to 1e-3 of themselves, files renamed, shuffled and
split into strokes, other units and signs through the config, idle columns, another seed, ...) and analysed
again. Verdict and effects (id, channels, acts_on, operation) must stay, and numbers move by at most a tenth
of a standard error, after conversion of units; the error after over that before by at most a tenth. The table
says, per campaign and change, what moved. Each pair is kept with the build that ran it (commit, and a hash of
what differs from it). Pairs that are in the file already are not run again; those of another build are, so
that no table mixes builds.

Two kinds of change do alter what the data say, and their numbers are held to what must follow from that.

A clock or a scale that is off by 1e-3 in each file is another measurement: a wavelength known to 3e-4 follows
it. The numbers must follow smoothly, without a decision that flips: they stay, or move ten times as far as
under the same jitter of 1e-4, within a tenth of a standard error; under that one they stay.

Estimates from all data and from all but a share f of them differ by chance, with a standard deviation of
sqrt(f / (1 - f)) standard errors (Hausman 1978, doi:10.2307/1913827: the variance of the difference is the
difference of the variances). Three of these are allowed. A file that is left out costs at most what its run
says, as contrasts between repeats go with it, and half of its rows cost half of that.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from campaigns import RIG
from commit import build
from effect_kinds import COLUMN, EFFECT_CAMPAIGNS
from measured import emps_plateaus, kidney_plain, measured

from sealfit.closure.loop import close_loop
from sealfit.config import parse_config
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.strokes import find_strokes
from sealfit.simulation import Spec, simulate

# Largest change of a number, in standard errors.
OF_SE = 0.1
# The same for a change with other bins.
BINNED = 0.5
# Largest difference of an estimate from fewer data, in standard deviations.
CHANCE = 3.0
# Largest relative change of a number without interval.
ROUNDING = 1e-5
# Largest relative change of the ratio of the errors after and before.
ERROR = 0.1
PREFIXES = {"N": 1.0, "mN": 1e-3, "mm": 1e-3, "m": 1.0, "s": 1.0, "ms": 1e-3}

# ---------------------------------------------------------------- campaigns
ROWS = 120
SPEEDS = (0.5, 2.0, 5.0, 15.0, 50.0)
ONE_WAY = {"temperatures_C": (60.0,), "days": (2.0, 16.0), "speeds_mm_s": SPEEDS, "start_scatter_mm": 4.0}
BOTH_WAYS = {**ONE_WAY, "days": (4.0,), "directions": (1, -1)}
AGED = {**ONE_WAY, "days": (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), "temperatures_C": (60.0, 80.0), "repeats": 2}
NULLS = {
    "null_white": ({"kind": "white", "sd_N": 0.2},),
    "null_rig": RIG,
    "null_setup": ({"kind": "run_setup", "sd_rel": 0.01, "sd_N": 0.1}, {"kind": "white", "sd_N": 0.05}),
}
MANY_RUNS = {
    **ONE_WAY,
    "days": (4.0,),
    "speeds_mm_s": tuple(np.geomspace(0.5, 50.0, 16).round(2)),
    "repeats": 2,
}
# A design of ten files.
SHORT = {**ONE_WAY, "days": (), "repeats": 2}
DESIGNS = {
    "column": MANY_RUNS,
    "batch": MANY_RUNS,
    "stribeck_exponent": MANY_RUNS,
    "log_rate": MANY_RUNS,
    "lab_temperature": MANY_RUNS,
    "column_step": MANY_RUNS,
    "product": MANY_RUNS,
    "asymmetry": BOTH_WAYS,
    "zero_offset": BOTH_WAYS,
    "there_and_back": {**BOTH_WAYS, "strokes_per_file": 2, "max_rows": 2 * ROWS},
    "run_in": {**BOTH_WAYS, "strokes_per_file": 5, "max_rows": 5 * ROWS},
    "short": SHORT,
    "aging_induction": {**AGED, "speeds_mm_s": (0.5, 5.0, 50.0)},
}
# Strength of effects: strong in `campaigns.py`.
STRENGTH = 10.0
OWN_NAME = (
    "asymmetry", "bump", "log_rate", "warming_power", "lab_temperature", "column_of_the_trace", "column_step",
    "product", "two_at_once",
)  # fmt: skip
KINDS = {
    "ripple": "ripple",
    "warming": "warming_distance",
    "zero_offset": "zero_offset",
    "there_and_back": "zero_offset",
    "run_in": "run_in",
    "short": "ripple",
    "drift": "drift",
    "conditioning": "conditioning",
    "column": "column_linear_mu",
    "batch": "column_category_mu",
    "aging_induction": "aging_induction",
    **{name: name for name in OWN_NAME},
}
EXPONENT = {
    "id": "stribeck_exponent",
    "parameters": {"A": 0.3, "v_s": 5.0, "n": 0.8},
    "acts_on": "mu",
    "operation": "add",
}


@dataclass(frozen=True)
class Campaign:
    """A campaign in memory: runs.csv and its traces by file name, and the config as TOML."""

    runs: pd.DataFrame
    traces: dict[str, pd.DataFrame]
    config: str

    @classmethod
    def read(cls, folder: Path, config: str) -> Campaign:
        """Return the campaign in `folder`."""
        runs = pd.read_csv(folder / "runs.csv")
        return cls(runs, {file: pd.read_csv(folder / file) for file in runs["file"]}, config)

    def write(self, folder: Path) -> None:
        """Write the campaign to `folder`."""
        for file, trace in self.traces.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            trace.to_csv(folder / file, index=False)
        self.runs.to_csv(folder / "runs.csv", index=False)

    def each(self, change: Callable[[pd.DataFrame], pd.DataFrame]) -> Campaign:
        """Return the campaign with every trace changed."""
        return replace(self, traces={file: change(trace) for file, trace in self.traces.items()})

    def told(self, **sections: Mapping[str, object]) -> Campaign:
        """Return the campaign with keys of the config set, section by section; "" is the top."""
        table = tomllib.loads(self.config)
        for section, keys in sections.items():
            table[section] = {**table.get(section, {}), **keys}
        return replace(self, config=toml(table))


def names() -> list[str]:
    """Names of all campaigns; the measured ones where SEALFIT_MEASURED names their folder."""
    return [*NULLS, *KINDS, "stribeck_exponent", *(("kidney", "emps") if measured() else ())]


def campaign(name: str) -> Campaign:
    """Return a campaign unchanged."""
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "c"
        if name in ("kidney", "emps"):
            config = (kidney_plain if name == "kidney" else emps_plateaus)(measured(), made)
            return Campaign.read(made, config.read_text())
        simulate(spec(name), made)
        return Campaign.read(made, "")


def spec(name: str) -> Spec:
    """Return the SPEC of a simulated campaign."""
    effects, channels, noise = (), (COLUMN,), RIG
    if name in NULLS:
        noise = NULLS[name]
    elif name == "stribeck_exponent":
        effects = (EXPONENT,)
    else:
        effects, own = EFFECT_CAMPAIGNS[KINDS[name]](STRENGTH)
        channels = own or channels
    design = {"max_rows": ROWS, **DESIGNS.get(name, ONE_WAY)}
    return Spec(
        name=name,
        seed=7,
        physics={"growth": {}},
        design=design,
        effects=effects,
        channels=channels,
        noise=noise,
    )


# ---------------------------------------------------------------- changes that change nothing
@dataclass(frozen=True)
class Change:
    """What is done to a campaign, and how its numbers may be compared with those before."""

    make: Callable[[Campaign, np.random.Generator], Campaign]
    tolerance: float = OF_SE
    shift_mm: float = 0.0  # of every position
    mirrored: bool = False  # directions change places: signs of odd amplitudes, places and phases turn round
    aliases: Mapping[str, str] = field(default_factory=dict)  # a copy's name -> the column's
    lost: float = 0.0  # runs' worth of data that are left out
    tenth: str = ""  # the same change, a tenth as large: numbers move in proportion


def jitter(column: str, size: float, *, samples: bool = False, tenth: str = "") -> Change:
    """Multiply a measured column by 1 + size z: one z a file (its clock, its scale), or one a sample."""

    def make(given: Campaign, rng: np.random.Generator) -> Campaign:
        return given.each(
            lambda trace: trace.assign(
                **{column: trace[column] * (1 + size * rng.standard_normal(len(trace) if samples else 1))}
            )
        )

    return Change(make, tenth=tenth)


def jitter_commanded(size: float) -> Change:
    """Jitter the commanded speeds, as where they are read from a controller."""

    def make(given: Campaign, rng: np.random.Generator) -> Campaign:
        if "speed_mm_s" not in given.runs:
            return given
        factor = 1 + size * rng.standard_normal(len(given.runs))
        return replace(given, runs=given.runs.assign(speed_mm_s=given.runs["speed_mm_s"] * factor))

    return Change(make)


def renamed(given: Campaign, rng: np.random.Generator) -> Campaign:
    """Give files names without meaning, in another order."""
    number = rng.permutation(len(given.runs))
    new = {file: f"trace_{k:04d}.csv" for file, k in zip(given.runs["file"], number, strict=True)}
    runs = given.runs.assign(file=given.runs["file"].map(new))
    return replace(given, runs=runs, traces={new[file]: trace for file, trace in given.traces.items()})


def shuffled(given: Campaign, rng: np.random.Generator) -> Campaign:
    """Shuffle the rows of runs.csv; repeats that are numbered by their place keep their numbers."""
    return replace(given, runs=given.runs.iloc[rng.permutation(len(given.runs))].reset_index(drop=True))


def units(force: float = 1.0, length: float = 1.0, clock: float = 1.0) -> Change:
    """Write the files in mN, m or ms and say so in the config; its own numbers in these units follow."""
    names = {
        "force": "mN" if force != 1 else "N",
        "length": "m" if length != 1 else "mm",
        "time": "ms" if clock != 1 else "s",
    }
    slots = {
        "force": {"quantity": "friction force", "unit": names["force"]},
        "load": {"quantity": "normal load", "unit": names["force"]},
        "displacement": {"quantity": "displacement", "unit": names["length"]},
        "speed": {"quantity": "speed", "unit": f"{names['length']}/{names['time']}"},
        "time": {"quantity": "time", "unit": names["time"]},
    }
    factors = {"force_N": force, "displacement_mm": length, "time_s": clock, "load_N": force}
    factors["speed_mm_s"] = length / clock

    def scaled(table: pd.DataFrame) -> pd.DataFrame:
        return table.assign(**{name: table[name] * by for name, by in factors.items() if name in table})

    def make(given: Campaign, rng: np.random.Generator) -> Campaign:
        made = replace(given.each(scaled), runs=scaled(given.runs))
        return made.told(quantities=slots, sensor={"accuracy": 0.2 * force})

    return Change(make)


def turned(column: str) -> Change:
    """Write a column with the other sign, which the config turns round again."""

    def make(given: Campaign, rng: np.random.Generator) -> Campaign:
        slots = [name for name in ("time_s", "displacement_mm", "force_N") if name != column]
        trace = {
            "columns": {**{name: name for name in slots}, "raw": "raw"},
            "compute": {column: "-raw"},
            "drop_columns": ["raw"],
        }
        return given.each(lambda t: t.rename(columns={column: "raw"}).assign(raw=-t[column])).told(
            trace=trace
        )

    return Change(make)


def mirrored(given: Campaign, rng: np.random.Generator) -> Campaign:
    """Turn the rig round: what was forward is backward, force and displacement with the other sign."""
    return given.each(lambda t: t.assign(force_N=-t["force_N"], displacement_mm=-t["displacement_mm"]))


def moved(shift_mm: float) -> Change:
    """Move the zero of the position."""

    def make(given: Campaign, rng: np.random.Generator) -> Campaign:
        return given.each(lambda t: t.assign(displacement_mm=t["displacement_mm"] + shift_mm))

    return Change(make, shift_mm=shift_mm)


def column(values: Callable[[pd.DataFrame, np.random.Generator], object], **aliases: str) -> Change:
    """Add a column `extra` to runs.csv."""
    return Change(
        lambda given, rng: replace(given, runs=given.runs.assign(extra=values(given.runs, rng))), **aliases
    )


def copied(given: Campaign, rng: np.random.Generator) -> Campaign:
    """Add a copy of the campaign's own column, or of the load."""
    own = next(
        (name for name in ("oil_ppm", "cleaner", "set_pressure_bar", "load_N") if name in given.runs), None
    )
    return (
        given if own is None else replace(given, runs=given.runs.assign(**{f"{own}_again": given.runs[own]}))
    )


def halved(given: Campaign, rng: np.random.Generator) -> Campaign:
    """Keep every second row of one file."""
    file = given.runs["file"][len(given.runs) // 3]
    return replace(given, traces={**given.traces, file: given.traces[file].iloc[::2]})


def one_left_out(given: Campaign, rng: np.random.Generator) -> Campaign:
    """Leave one file out."""
    gone = len(given.runs) // 2
    traces = {file: trace for file, trace in given.traces.items() if file != given.runs["file"][gone]}
    return replace(given, runs=given.runs.drop(index=gone).reset_index(drop=True), traces=traces)


def split(given: Campaign, rng: np.random.Generator) -> Campaign:
    """Write every stroke of a file as a file of its own, its number in a column `stroke` of runs.csv."""
    rows, traces, settings = [], {}, parse_config(given.config, "split").strokes
    for row in given.runs.to_dict("records"):
        trace = given.traces[row["file"]].reset_index(drop=True)
        slots = (trace[name].to_numpy() for name in ("time_s", "displacement_mm", "force_N"))
        strokes = find_strokes(*slots, settings)
        for number, stroke in enumerate(strokes, start=1) if len(strokes) > 1 else ():
            own = trace.iloc[stroke.start : stroke.stop]
            file = f"{row['file'].removesuffix('.csv')}_{number}.csv"
            traces[file] = own.assign(time_s=own["time_s"] - own["time_s"].iloc[0])
            rows.append({**row, "file": file, "stroke": number})
    return replace(given, runs=pd.DataFrame(rows), traces=traces) if rows else given


CHANGES: dict[str, Change] = {
    **{f"jitter_{what}_{size}": jitter(
           name, float(size), tenth=f"jitter_{what}_1e-4" if size == "1e-3" else ""
       )
       for what, name in (("time", "time_s"), ("position", "displacement_mm"))
       for size in ("1e-6", "1e-4", "1e-3")},
    "jitter_samples_1e-6": jitter("displacement_mm", 1e-6, samples=True),
    "jitter_force_1e-6": jitter("force_N", 1e-6, samples=True),
    "jitter_commanded_1e-6": jitter_commanded(1e-6),
    "jitter_commanded_1e-3": jitter_commanded(1e-3),
    "renamed": Change(renamed),
    "shuffled": Change(shuffled),
    "mN": units(force=1e3),
    "metre": units(length=1e-3),
    "ms": units(clock=1e3),
    "force_turned": turned("force_N"),
    "position_turned": turned("displacement_mm"),
    "mirrored": Change(mirrored, mirrored=True),
    "moved": moved(137.3),
    "constant_column": column(lambda runs, rng: 4.0),
    "idle_column": column(lambda runs, rng: rng.standard_normal(len(runs)).round(4)),
    "serial_number": column(lambda runs, rng: [f"N{k}" for k in range(len(runs))]),
    "copied_column": Change(
        copied, aliases={f"{own}_again": own for own in ("oil_ppm", "cleaner", "set_pressure_bar", "load_N")}
    ),
    "split": Change(split),
    "half_rate": Change(halved, lost=0.5),
    "one_left_out": Change(one_left_out, lost=1.0),
    "seed": Change(lambda given, rng: given.told(loop={"seed": 11})),
    "bins_20": Change(lambda given, rng: given.told(bins={"per_stroke": 20}), BINNED),
    "bins_80": Change(lambda given, rng: given.told(bins={"per_stroke": 80}), BINNED),
}  # fmt: skip


# ---------------------------------------------------------------- what moved
def closed(given: Campaign) -> dict:
    """Return closure.json of a campaign."""
    config = parse_config(given.config, "invariances")
    with tempfile.TemporaryDirectory() as folder:
        given.write(Path(folder))
        tables = ingest_campaign(Path(folder), config, workers=1).tables
    return json.loads(
        json.dumps(close_loop(tables["bins"], tables["traces"], config).document, default=float)
    )


def toml(table: Mapping) -> str:
    """Return a config of plain values as TOML: keys of the top first, tables inline."""
    return "\n".join(f"{key} = {_inline(value)}" for key, value in table.items()) + "\n"


def _inline(value: object) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(k)} = {_inline(v)}" for k, v in value.items()) + "}"
    return json.dumps(value)


def moved_by(name: str, closures: Mapping[str, dict], runs: int) -> list[str]:
    """Return what a change moved, from the closures of a campaign of so many runs by change."""
    before, change = closures["as it is"], CHANGES[name]
    if change.lost:
        change = replace(change, tolerance=CHANCE * float(np.sqrt(change.lost / (runs - change.lost))))
    found = moves(before, closures[name], change)
    if found and change.tenth in closures:
        return moves(in_proportion(before, closures[change.tenth]), closures[name], change)
    return found


def in_proportion(before: dict, tenth: dict) -> dict:
    """Return a closure with its numbers moved ten times as far as a change a tenth as large moves them."""
    found, effects = _by_key(tenth["effects"], {}), []
    for key, effect in _by_key(before["effects"], {}).items():
        near = {p["name"]: p["value"] for p in found.get(key, effect)["parameters"]}
        numbers = [
            {**p, "value": _ten_times(p["name"], p["value"], near[p["name"]])} for p in effect["parameters"]
        ]
        effects.append({**effect, "parameters": numbers})
    return {**before, "effects": effects}


def _ten_times(name: str, a: float | None, b: float | None) -> float | None:
    if a is None or b is None:
        return a
    return a + 10 * ((b - a + np.pi) % (2 * np.pi) - np.pi if name == "phi" else b - a)


def moves(before: dict, after: dict, change: Change) -> list[str]:
    """Return in words what differs between two closures beyond what a change allows; none if nothing does."""
    found = []
    if before["verdict"] != after["verdict"]:
        found.append(f"verdict {before['verdict']} -> {after['verdict']}")
    ratios = [closure["after"]["rmse_N"] / closure["before"]["rmse_N"] for closure in (before, after)]
    if abs(np.log(ratios[1] / ratios[0])) > ERROR:
        found.append(f"error after over before {ratios[0]:.3g} -> {ratios[1]:.3g}")
    old, new = (_by_key(closure["effects"], change.aliases) for closure in (before, after))
    found += [f"lost {_words(key)}" for key in old if key not in new]
    found += [f"new {_words(key)}" for key in new if key not in old]
    for key in old.keys() & new.keys():
        found += _numbers(old[key], new[key], change)
    return found


def _by_key(effects: list[dict], aliases: Mapping[str, str]) -> dict[tuple, dict]:
    """Return effects by what they are; several of one kind (ripples) are numbered by their wavelengths."""
    groups: dict[tuple, list[dict]] = {}
    for effect in effects:
        groups.setdefault(_key(effect, aliases), []).append(effect)
    return {
        (*key, number): effect
        for key, group in groups.items()
        for number, effect in enumerate(sorted(group, key=_wavelength))
    }


def _wavelength(effect: dict) -> float:
    return next((p["value"] * factor(p["unit"]) for p in effect["parameters"] if p["name"] == "lambda"), 0.0)


def _key(effect: dict, aliases: Mapping[str, str]) -> tuple:
    channels = tuple(sorted(aliases.get(name, name) for name in effect["channels"]))
    return effect["id"], channels, effect["acts_on"], effect["operation"], effect["candidate"]


def _words(key: tuple) -> str:
    id, channels, acts_on, operation, candidate, *_ = key
    return f"{id}({', '.join(channels)}) {operation} {acts_on}{' candidate' if candidate else ''}"


def _numbers(old: dict, new: dict, change: Change) -> list[str]:
    if not old["named"] or not new["named"]:
        return [] if old["named"] == new["named"] else [f"{old['id']} named {old['named']} -> {new['named']}"]
    found = []
    values = {p["name"]: p for p in old["parameters"]}
    if values.keys() != {p["name"] for p in new["parameters"]}:
        return [f"{old['id']}: other parameters"]
    for p in new["parameters"]:
        was = values[p["name"]]
        if None in (p["value"], was["value"], was["ci95"][0], was["ci95"][1]):
            continue
        unit, own = factor(was["unit"]), factor(p["unit"])
        a, b, se = was["value"] * unit, p["value"] * own, (was["ci95"][1] - was["ci95"][0]) / 3.92 * unit
        apart = _apart(p["name"], a, b, old, change, values)
        if apart > change.tolerance * se + ROUNDING * abs(a):
            found.append(f"{old['id']} {p['name']} by {apart / max(se, 1e-300):.2g} se")
    return found


def _apart(name: str, a: float, b: float, effect: dict, change: Change, values: dict) -> float:
    """Return how far two values of a parameter are apart, in base units, after what the change does to it."""
    on_position = "displacement_mm" in effect["channels"]
    if name == "phi":
        expected = a
        if on_position and change.shift_mm:
            expected = a - 2 * np.pi * change.shift_mm / values["lambda"]["value"]
        return 0.0 if change.mirrored else abs((b - expected + np.pi) % (2 * np.pi) - np.pi)
    if on_position and name.startswith("x_"):
        return 0.0 if change.mirrored else abs(b - a - change.shift_mm * 1e-3)
    return abs(abs(b) - abs(a)) if change.mirrored else abs(b - a)


def factor(unit: str) -> float:
    """Return how many of the base units (N, m, s) a unit is; what is none of these counts as 1."""
    text = re.sub(r"[A-Za-z%]+", lambda word: repr(PREFIXES.get(word[0], 1.0)), unit.replace("^", "**"))
    text = re.sub(r"[^0-9.e+\-*/() ]", "", text).strip()
    text = re.sub(r"(?<=[0-9.)])\s+(?=[0-9(])", "*", text)
    return float(eval(text, {"__builtins__": {}})) if text else 1.0  # digits and operators only


# ---------------------------------------------------------------- the table
def main(arguments: list[str] | None = None) -> int:
    """Run the command line, print the table, and return 1 if any result changed."""
    parser = argparse.ArgumentParser(
        description="Close the loop again on campaigns changed in what does not matter."
    )
    parser.add_argument("--list", action="store_true", help="print campaigns and changes")
    parser.add_argument("--campaigns", nargs="+", choices=names(), default=names(), metavar="NAME")
    parser.add_argument("--changes", nargs="+", choices=list(CHANGES), default=list(CHANGES), metavar="NAME")
    parser.add_argument("--out", type=Path, default=Path("out/invariances.jsonl"), metavar="JSONL")
    given = parser.parse_args(arguments)
    if given.list:
        print("campaigns:", *names(), "\nchanges:", *CHANGES)
        return 0
    given.out.parent.mkdir(parents=True, exist_ok=True)
    own = build()
    done = _read(given.out, own)
    with given.out.open("a") as file:
        for name in given.campaigns:
            tenths = [CHANGES[change].tenth for change in given.changes if CHANGES[change].tenth]
            wanted = dict.fromkeys(("as it is", *tenths, *given.changes))
            wanted = [change for change in wanted if (name, change) not in done]
            made = campaign(name) if wanted else None
            for number, change in enumerate(wanted):
                row = {"build": own, **_run(name, change, made)}
                done[name, change] = row
                print(json.dumps(row), file=file, flush=True)
                said = f"{name}: {number + 1} of {len(wanted)}, {change}: {row.get('error') or 'done'}"
                print(f"{said} ({row['seconds']} s)", file=sys.stderr)
    moved = table(done, given.campaigns, given.changes)
    print("\n".join([f"build {own}", "", *moved.lines]))
    return int(moved.count > 0)


def _read(path: Path, own: str) -> dict[tuple[str, str], dict]:
    """Return the pairs of a file that a build has run, by campaign and change."""
    lines = path.read_text().splitlines() if path.is_file() else []
    rows = [row for row in map(json.loads, lines) if row.get("build") == own]
    return {(row["campaign"], row["change"]): row for row in rows}


def _run(name: str, change: str, made: Campaign) -> dict:
    began = time.monotonic()
    row = {
        "campaign": name,
        "change": change,
        "runs": int(made.runs.get("run_id", made.runs["file"]).nunique()),
    }
    try:
        rng = np.random.default_rng(5)
        closure = closed(made if change == "as it is" else CHANGES[change].make(made, rng))
        row["closure"] = {key: closure[key] for key in ("verdict", "effects", "before", "after")}
    except Exception as error:  # a campaign that cannot be analysed once changed is a finding
        row["error"] = f"{type(error).__name__}: {str(error)[:200]}"
    return {**row, "seconds": round(time.monotonic() - began, 1)}


@dataclass(frozen=True)
class Moved:
    """The table as lines, and how many pairs moved."""

    lines: list[str]
    count: int


def table(done: Mapping, campaigns: list[str], changes: list[str]) -> Moved:
    """Return what moved, a line for each pair of campaign and change where anything did."""
    lines, count, pairs = ["| campaign | change | what moved |", "|---|---|---|"], 0, 0
    for name in campaigns:
        base = done.get((name, "as it is"), {})
        closures = {
            change: row["closure"] for (own, change), row in done.items() if own == name and "closure" in row
        }
        verdict = base.get("closure", {}).get("verdict", base.get("error", "not run"))
        effects = [_words(_key(e, {})) for e in base.get("closure", {}).get("effects", ())]
        lines.append(f"| {name} | as it is | {verdict}: {'; '.join(effects) or 'no effect'} |")
        for change in changes:
            row = done.get((name, change))
            if row is None or "closure" not in base:
                continue
            pairs += 1
            found = [row["error"]] if "error" in row else moved_by(change, closures, base["runs"])
            if found:
                count += 1
                lines.append(f"| {name} | {change} | {'; '.join(found)} |")
    return Moved([*lines, "", f"{count} of {pairs} pairs moved."], count)


if __name__ == "__main__":
    raise SystemExit(main())
