"""Record what sealfit says of ten campaigns, and compare it with what it said before.

    python tests/golden/golden.py [NAME ...]       record anew, after a change that is meant to move a number

Fitted numbers may differ by a hundredth of their standard errors; verdicts, effects and findings are compared
exactly.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from typer.testing import CliRunner

ROOT = Path(__file__).parents[2]
RECORDS = Path(__file__).parent / "records"
sys.path.insert(0, str(ROOT / "benchmarks"))

OF_SE = 0.01
"""Of a standard error, by which a fitted number may move."""

RELATIVE = 1e-3
"""Of a standard error or an RMS error itself, by which it may move."""

Z95 = 1.96
POINTS = 24
KEPT = 150
"""Fitted parameters, and findings, that a record keeps, evenly spread."""

FITS = ("steady_fit", "aging_fit", "dynamic_fit")
EXACT = ("id", "channels", "level", "acts_on", "operation", "named", "candidate")
FINDING = ("file", "stroke", "line", "check", "severity", "action")


def stored(folder: str, config: str | None = None) -> Callable[[Path], list[str]]:
    """Return what gives the arguments of `run` for a campaign of sample_data."""
    named = [] if config is None else ["--config", str(ROOT / "configs" / config)]
    return lambda _: [str(ROOT / "sample_data" / folder), *named]


def simulated(name: str) -> Callable[[Path], list[str]]:
    """Return the same for a campaign of the loop's benchmark: 120 rows a file, strong effects."""

    def make(folder: Path) -> list[str]:
        from campaigns import campaign

        from sealfit.simulation import simulate

        simulate(campaign(name, seed=1, strength="strong", rows=120), folder / "campaign")
        return [str(folder / "campaign")]

    return make


def many(folder: Path) -> list[str]:
    """Return the same for 4,800 short files, of which the loop searches some."""
    from many_files import write_campaign

    write_campaign(folder / "campaign", 4800, effect="conditioning")
    return [str(folder / "campaign")]


CAMPAIGNS: Mapping[str, Callable[[Path], list[str]]] = {
    "sample": stored("simulated"),
    "screwdrive": stored("measured/screwdrive", "screwdrive.toml"),
    "pneuseal": stored("measured/pneuseal-repeats", "pneuseal.toml"),
    "null_run_setup": simulated("null_run_setup"),
    "ripple": simulated("ripple"),
    "warming_distance": simulated("warming_distance"),
    "zero_offset": simulated("zero_offset"),
    "two_at_once": simulated("two_at_once"),
    "three_at_once": simulated("three_at_once"),
    "many": many,
}


def record(name: str) -> dict:
    """Return what sealfit says of a campaign: numbers and standard errors, effects, findings, predictions."""
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home)
        out = folder / "out"
        _sealfit("run", *CAMPAIGNS[name](folder), "--out", str(out))
        closure = json.loads((out / "closure.json").read_text("utf-8"))
        tables = {p.stem: pd.read_parquet(p) for p in sorted(out.glob("*.parquet"))}
        predicted = _predicted(out, tables["bins"])
    return {
        # A candidate of table `channels` may be at the edge of what is tested, by the last digit.
        "rows": {table: len(rows) for table, rows in tables.items() if table != "channels"},
        "fits": _some(
            [
                pair
                for table in tables
                if table.removesuffix("_after") in FITS
                for pair in _fits(tables, table)
            ]
        ),
        "verdict": closure["verdict"],
        "fit_quality": closure["fit_quality"]["state"],
        "errors": {
            f"{end} {key}": value for end in ("before", "after") for key, value in closure[end].items()
        },
        "effects": [{key: effect[key] for key in EXACT} for effect in closure["effects"]],
        "parameters": {
            f"{k} {p['name']}": _with_se(p["value"], p["ci95"])
            for k, e in enumerate(closure["effects"])
            for p in e["parameters"]
        },
        "refused": [[item["id"], item["channels"], item["acts_on"]] for item in closure["refused"]],
        "findings": _findings(tables["quality"]),
        "predictions": predicted,
    }


def _sealfit(*arguments: str) -> None:
    from sealfit.cli import app

    result = CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    if result.exit_code:
        raise RuntimeError(f"sealfit {' '.join(arguments)}: {result.output}")


def _fits(tables: Mapping[str, pd.DataFrame], table: str) -> Iterator[tuple[str, list]]:
    """Yield a name and [value, standard error] for each fitted parameter of a table."""
    rows = tables[table]
    keys = [
        c
        for c in ("condition", "series", "rubber", "direction", "speed_set_mm_s", "quantity", "parameter")
        if c in rows
    ]
    for row in rows[rows["se"].notna()].to_dict("records"):
        yield " | ".join([table, *(str(row[key]) for key in keys)]), [row["value"], row["se"]]


def _some(fits: list[tuple[str, list]]) -> dict[str, list]:
    """Return `KEPT` of the fitted parameters, and how many there are."""
    return {"number": [len(fits), None], **dict(fits[k] for k in _spread(len(fits)))}


def _spread(count: int) -> list[int]:
    """Return up to `KEPT` places of `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, KEPT)).round().astype(int)).tolist()


def _with_se(value: float | None, interval: list) -> list:
    return [value, None if None in interval else (interval[1] - interval[0]) / (2 * Z95)]


def _findings(quality: pd.DataFrame) -> list[list]:
    """Return the findings about files without their numbers, in order: how many, and `KEPT` of them."""
    rows = quality[[c for c in FINDING if c in quality]].astype(object).where(lambda t: t.notna(), None)
    found = sorted([str(x) for x in row] for row in rows.to_numpy().tolist())
    return [[len(found)], *(found[k] for k in _spread(len(found)))]


def _predicted(out: Path, bins: pd.DataFrame) -> list[list]:
    """Return the answers of `predict` at bins spread over the campaign.

    Each has the force before and after, the standard error, and whether it is extrapolated.
    """
    ordered = bins.sort_values(
        ["file", "stroke", "bin"]
    )  # which of its files a table was stored in does not matter
    chosen = ordered.iloc[np.linspace(0, len(bins) - 1, POINTS).round().astype(int)]
    points = chosen.drop(columns=[c for c in chosen if c.startswith("force") or c == "presliding_N"])
    points.to_csv(out.parent / "points.csv", index=False)
    _sealfit(
        "predict",
        str(out),
        "--points",
        str(out.parent / "points.csv"),
        "--output",
        str(out.parent / "said.csv"),
    )
    said = pd.read_csv(out.parent / "said.csv")
    error = (said["force_after_hi95_N"] - said["force_after_lo95_N"]) / (2 * Z95)
    table = pd.DataFrame(
        {
            "before": said["force_before_N"],
            "after": said["force_after_N"],
            "se": error,
            "outside": said["extrapolated"],
        }
    )
    return table.astype(object).where(table.notna(), None).to_numpy().tolist()


def differences(old: Mapping, new: Mapping) -> list[str]:
    """Return in words what differs between two records by more than it may."""
    found = [f"{key}: {old[key]} -> {new[key]}" for key in old if _exact(key) and old[key] != new[key]]
    for key in ("fits", "parameters"):
        found += [f"{key}: {name} is missing or new" for name in sorted(set(old[key]) ^ set(new[key]))]
        shared = [name for name in old[key] if name in new[key]]
        found += [
            f"{name}: {old[key][name]} -> {new[key][name]}"
            for name in shared
            if not _same(old[key][name], new[key][name])
        ]
    for name, value in old["errors"].items():
        if not _close(value, new["errors"].get(name), RELATIVE * abs(value or 0.0)):
            found.append(f"{name}: {value} -> {new['errors'].get(name)}")
    for k, (was, now) in enumerate(zip(old["predictions"], new["predictions"], strict=True)):
        moved = any(not _same([a, was[2]], [b, now[2]]) for a, b in zip(was[:2], now[:2], strict=True))
        if moved or was[3] != now[3]:
            found.append(f"prediction {k}: {was} -> {now}")
    return found


def _exact(key: str) -> bool:
    return key not in ("fits", "parameters", "errors", "predictions")


def _same(old: list, new: list) -> bool:
    """Whether a value is the same within a share of its standard error.

    A value without one has to be the same within `RELATIVE` of itself.
    """
    if (old[1] is None) != (new[1] is None):
        return False
    if old[1] is None:
        return _close(old[0], new[0], RELATIVE * abs(old[0] or 0.0))
    return _close(old[0], new[0], OF_SE * old[1]) and _close(old[1], new[1], OF_SE * old[1])


def _close(old: float | None, new: float | None, by: float) -> bool:
    if old is None or new is None:
        return old is new
    return abs(new - old) <= by + 1e-12


def rounded(value: object) -> object:
    """Return a record with its numbers rounded to 8 digits."""
    if isinstance(value, dict):
        return {key: rounded(own) for key, own in value.items()}
    if isinstance(value, list):
        return [rounded(own) for own in value]
    return float(f"{value:.8g}") if isinstance(value, float) else value


def main(names: list[str]) -> None:
    """Record the named campaigns, or all."""
    RECORDS.mkdir(exist_ok=True)
    for name in names or CAMPAIGNS:
        text = json.dumps(rounded(record(name)), indent=1, ensure_ascii=False)
        text = re.sub(r"\n {3,}| {0,2}\n {2}(?=\])|\n {2}(?=\})", " ", text)  # a line for each entry
        (RECORDS / f"{name}.json").write_text(text + "\n", encoding="utf-8")
        print(name)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main(sys.argv[1:])
