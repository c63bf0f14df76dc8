"""Write a campaign of as many files as wanted, fast: to measure how ingest and fits grow with the campaign.

    python benchmarks/many_files.py --files 100000 --out DIR [--rows 80] [--seed 1]
                                    [--effect conditioning] [--strength 1]

100,000 files take half a minute.

Every file is a ramp, a pre-sliding rise and steady sliding with noise; forces follow Eq. 14 and 15 of
`sealfit.physics`, so that fits make sense. Eight speeds and three repeats a condition; with the number of
files grow the temperatures, the compressions, the days, the loads and the specimens, as they do in
laboratories. At most 1,000 files a folder. With --effect something that nobody declared is in all of them, of
the size that `effect_kinds.py` gives it at that strength.

Text is put together from cells that are formatted once: positions and times per speed and starting point,
forces in steps of 0.01 N. `sealfit simulate` knows far more and is some fifty times slower.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from datetime import datetime, timedelta
from operator import add
from pathlib import Path

import numpy as np

from sealfit.physics import aging_law, stribeck_force

SPEEDS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 50.0)
REPEATS = 3
PER_FOLDER = 1000
# Number of starting points of a stroke.
STARTS = 16
STROKE_MM, RAMP_S, RISE_MM = 20.0, 0.1, 0.3
# Share of the rows before the motion starts.
REST_ROWS = 0.05
# Relative scatter of specimen, set-up and repeat each.
SCATTER = 0.005
NOISE_N, POSITION_NOISE_MM = 0.1, 0.002
MU_S, MU_C = {"mu_0": 0.935, "b": 0.08}, {"mu_0": 0.61, "b": 0.13}
V_S, SIGMA_2 = 5.0, 0.05
EFFECTS = ("conditioning", "warming_distance", "ripple")
BEGIN = datetime(2024, 1, 8, 8)
HEADER = "time_s,displacement_mm,force_N\n"
RUNS = (
    "file,run_id,repeat,specimen_id,temperature_C,compression_ratio_pct,aging_days,load_N,speed_mm_s,"
    "started_at\n"
)


@dataclass(frozen=True, slots=True)
class Design:
    """What is varied; unaged rubber is one condition more."""

    temperatures_C: tuple[float, ...]
    compressions_pct: tuple[float, ...]
    days: tuple[float, ...]
    loads_N: tuple[float, ...]
    specimens: int

    @property
    def files_per_condition(self) -> int:
        return len(self.loads_N) * self.specimens * len(SPEEDS) * REPEATS

    @property
    def conditions(self) -> np.ndarray:
        """Temperature, compression and days of conditions, shape (conditions, 3); a series' days in a row."""
        grid = np.meshgrid(self.temperatures_C, self.compressions_pct, self.days, indexing="ij")
        return np.vstack([[23.0, 100.0, 0.0], np.column_stack([axis.ravel() for axis in grid])])


def design_for(files: int) -> Design:
    """Return a design of at least `files`: 42 conditions of 24 files for 1,000, 1,043 of 96 for 100,000."""
    loads = (49.03,) if files < 5_000 else (49.03, 98.07)
    specimens = 1 if files < 50_000 else 2
    conditions = max(int(np.ceil(files / (len(loads) * specimens * len(SPEEDS) * REPEATS))) - 1, 1)
    days = min(max(int(np.sqrt(conditions)), 1), 16)
    series = int(np.ceil(conditions / days))
    temperatures = int(np.ceil(np.sqrt(1.5 * series)))
    compressions = int(np.ceil(series / temperatures))
    return Design(
        tuple(np.round(np.linspace(20.0, 90.0, temperatures), 1).tolist()),
        tuple(np.round(np.linspace(70.0, 95.0, compressions), 1).tolist()),
        tuple(np.unique(np.round(np.geomspace(1.0, 64.0, days), 1)).tolist()),
        loads,
        specimens,
    )


def write_campaign(
    folder: Path,
    files: int,
    *,
    rows: int = 80,
    seed: int = 1,
    effect: str | None = None,
    strength: float = 1.0,
) -> Design:
    """Write runs.csv and the trace files into `folder`, one of EFFECTS in them; the design they follow."""
    rng = np.random.default_rng(seed)
    design = design_for(files)
    runs = _Runs.of(design, files, rng)
    motions = _Motions.make(rows, rng)
    for first in range(0, files, PER_FOLDER):
        place = folder / "traces" / f"{first // PER_FOLDER:04d}"
        place.mkdir(parents=True, exist_ok=True)
        block = slice(first, min(first + PER_FOLDER, files))
        for path, text in zip(
            runs.path[block], motions.texts(runs, block, rng, effect, strength), strict=True
        ):
            (folder / path).write_text(text, "ascii")
    (folder / "runs.csv").write_text(RUNS + "".join(runs.lines()), "ascii")
    return design


def add_files(folder: Path, *, seed: int = 2, rows: int = 80) -> list[str]:
    """Add a run of three repeats on a new specimen at a condition that the campaign has; their paths."""
    lines = (folder / "runs.csv").read_text("ascii").splitlines()
    like = dict(zip(RUNS.strip().split(","), lines[1 + len(lines) // 2].split(","), strict=True))
    last = max(datetime.fromisoformat(line.rsplit(",", 1)[1]) for line in lines[1:])
    number = sum("_added" in line for line in lines) // REPEATS + 1
    rng = np.random.default_rng(seed + number)
    runs = _Runs(
        condition=np.tile([float(like[name]) for name in RUNS.split(",")[4:7]], (REPEATS, 1)),
        load_N=np.full(REPEATS, float(like["load_N"])),
        speed=np.full(REPEATS, SPEEDS.index(float(like["speed_mm_s"]))),
        repeat=np.arange(1, REPEATS + 1),
        specimen=np.full(REPEATS, 100 + number),
        gain=1.0 + SCATTER * rng.standard_normal(REPEATS),
        minute=np.arange(1, REPEATS + 1) + (last - BEGIN).total_seconds() / 60.0,
        mark=f"_added{number}",
    )
    parent = Path(like["file"]).parent
    runs.path = [f"{parent.as_posix()}/{Path(path).name}" for path in runs.path]
    for path, text in zip(runs.path, _Motions.make(rows, rng).texts(runs, slice(None), rng), strict=True):
        (folder / path).write_text(text, "ascii")
    with (folder / "runs.csv").open("a", encoding="ascii") as table:
        table.write("".join(runs.lines()))
    return runs.path


@dataclass(slots=True)
class _Runs:
    """What runs.csv says of every file; arrays of one length."""

    condition: np.ndarray  # shape (files, 3)
    load_N: np.ndarray
    speed: np.ndarray  # place in SPEEDS
    repeat: np.ndarray
    specimen: np.ndarray
    gain: np.ndarray  # of the friction of this specimen, set-up and repeat
    minute: np.ndarray  # since BEGIN
    mark: str = ""
    path: list[str] = None

    def __post_init__(self) -> None:
        if self.path is None:
            names = zip(self.names(), self.repeat.tolist(), strict=True)
            self.path = [
                f"traces/{k // PER_FOLDER:04d}/{name}_r{repeat}.csv" for k, (name, repeat) in enumerate(names)
            ]

    @classmethod
    def of(cls, design: Design, files: int, rng: np.random.Generator) -> _Runs:
        """Return the first `files` files of a design, a condition after the other."""
        shape = (len(design.conditions), len(design.loads_N), design.specimens, len(SPEEDS), REPEATS)
        where = np.unravel_index(np.arange(files), shape)
        condition, load, specimen, speed, repeat = where
        setup = np.ravel_multi_index(where[:-1], shape[:-1])
        piece = condition * design.specimens + specimen
        scatter = [rng.standard_normal(int(of.max()) + 1)[of] for of in (piece, setup, np.arange(files))]
        days = design.conditions[condition, 2]
        order = np.argsort(days, kind="stable")
        minute = np.empty(files)
        minute[order] = np.arange(files) - np.searchsorted(days[order], days[order]) + 24 * 60 * days[order]
        gain = 1.0 + SCATTER * np.sum(scatter, axis=0)
        load_N = np.array(design.loads_N)[load]
        return cls(design.conditions[condition], load_N, speed, repeat + 1, specimen + 1, gain, minute)

    def names(self) -> list[str]:
        """Run of every file: its condition, load, speed and specimen."""
        return [
            f"T{t:g}_c{c:g}_d{d:g}_L{load:g}_v{SPEEDS[speed]:g}_s{specimen}{self.mark}"
            for (t, c, d), load, speed, specimen in zip(
                self.condition.tolist(), self.load_N.tolist(), self.speed, self.specimen.tolist(), strict=True
            )
        ]

    def lines(self) -> list[str]:
        """Return the lines of runs.csv."""
        return [
            f"{path},{name},{repeat},T{t:g}_c{c:g}_d{d:g}_s{specimen},{t:g},{c:g},{d:g},{load:g},{SPEEDS[speed]:g},"
            f"{(BEGIN + timedelta(minutes=round(minute))).isoformat()}\n"
            for path, name, (t, c, d), load, speed, repeat, specimen, minute in zip(
                self.path, self.names(), self.condition.tolist(), self.load_N.tolist(), self.speed,
                self.repeat.tolist(), self.specimen.tolist(), self.minute.tolist(), strict=True
            )
        ]  # fmt: skip


@dataclass(slots=True)
class _Motions:
    """The platform's motion for every speed and start: cells as text, and what the force depends on."""

    cells: list[list[list[str]]]  # "time,displacement," of every row
    speed_mm_s: np.ndarray  # shape (speeds, rows)
    slid_mm: np.ndarray  # from the start of the stroke, shape (speeds, rows)
    start_mm: np.ndarray  # of the starting points
    risen: np.ndarray  # share of the steady force that the bristles have reached, shape (speeds, rows)

    @classmethod
    def make(cls, rows: int, rng: np.random.Generator) -> _Motions:
        cells, speeds, distances = [], [], []
        starts = rng.uniform(0.0, 4.0, STARTS)
        for speed in SPEEDS:
            ramp = min(RAMP_S, 0.1 * STROKE_MM / speed)
            moving = STROKE_MM / speed + ramp
            rest = REST_ROWS * moving
            time = np.linspace(0.0, rest + moving, rows)
            since = np.clip(time - rest, 0.0, moving)
            fine = np.linspace(0.0, moving, 20_000)
            now = speed * np.minimum(np.minimum(fine / ramp, (moving - fine) / ramp), 1.0)
            slid = np.interp(
                since, fine, np.concatenate([[0.0], np.cumsum((now[1:] + now[:-1]) / 2 * fine[1]).ravel()])
            )
            # At rest after the stop the bristles stay bent, so the speed ends at next to nothing.
            speeds.append(np.where(since > 0.0, np.maximum(np.interp(since, fine, now), 1e-3), 0.0))
            distances.append(slid)
            clock = [f"{second:.5f}," for second in time]
            cells.append(
                [
                    [
                        f"{text}{place:.5f},"
                        for text, place in zip(clock, start + slid + POSITION_NOISE_MM * noise, strict=True)
                    ]
                    for start, noise in zip(starts, rng.standard_normal((STARTS, rows)), strict=True)
                ]
            )
        slid = np.array(distances)
        return cls(cells, np.array(speeds), slid, starts, -np.expm1(-slid / RISE_MM))

    def texts(
        self,
        runs: _Runs,
        block: slice,
        rng: np.random.Generator,
        effect: str | None = None,
        strength: float = 1.0,
    ) -> list[str]:
        """Return the text of every file of a block."""
        kind = runs.speed[block]
        force = _force_N(runs, block, self.speed_mm_s[kind]) * self.risen[kind]
        noise = NOISE_N * rng.standard_normal(force.shape)
        start = rng.integers(STARTS, size=len(kind))
        slid = self.slid_mm[kind]
        force += self.risen[kind] * _hidden_N(
            effect, strength, force, runs.repeat[block][:, None], slid, self.start_mm[start][:, None] + slid
        )
        force += noise
        hundredths = np.rint(100.0 * force).astype(int)
        low = int(hundredths.min())
        words = np.array([f"{k / 100:.2f}\n" for k in range(low, int(hundredths.max()) + 1)], object)
        return [
            HEADER + "".join(map(add, self.cells[speed][place], words[row - low]))
            for speed, place, row in zip(kind, start, hundredths, strict=True)
        ]


def _force_N(runs: _Runs, block: slice, speed_mm_s: np.ndarray) -> np.ndarray:
    """Return the force of steady sliding at these speeds, shape (files, rows)."""
    temperature, compression, days = runs.condition[block].T
    faster = 2.0 ** ((temperature - 60.0) / 40.0) * (1.0 + 0.005 * (80.0 - compression))
    mu_s = aging_law(days, a=0.044 * faster**0.5, **MU_S)
    mu_c = aging_law(days, a=0.033 * faster**0.5, **MU_C)
    laws = {"mu_s": mu_s[:, None], "mu_c": mu_c[:, None], "v_s": V_S, "sigma_2": SIGMA_2}
    return stribeck_force(speed_mm_s, runs.load_N[block][:, None], **laws) * runs.gain[block][:, None]


def _hidden_N(
    effect: str | None,
    strength: float,
    force_N: np.ndarray,
    repeat: np.ndarray,
    slid_mm: np.ndarray,
    place_mm: np.ndarray,
) -> np.ndarray | float:
    """Return what an effect adds to the force, shape (files, rows)."""
    match effect:
        case None:
            return 0.0
        case "conditioning":
            return -0.01 * strength * -np.expm1(1.0 - repeat) * force_N
        case "warming_distance":
            return 0.01 * strength * -np.expm1(-slid_mm / 10.0) * force_N
        case "ripple":
            return 0.1 * strength * np.sin(2 * np.pi * place_mm / 5.0 + 0.7)
    raise ValueError(f"{effect!r} is none of {EFFECTS}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--files", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--rows", type=int, default=80, help="of every file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--effect", choices=EFFECTS, help="in all of them, which nobody declared")
    parser.add_argument("--strength", type=float, default=1.0)
    given = parser.parse_args()
    hidden = {"effect": given.effect, "strength": given.strength}
    design = write_campaign(given.out, given.files, rows=given.rows, seed=given.seed, **hidden)
    used = -(-given.files // design.files_per_condition)
    print(f"{given.files} files of {given.rows} rows, {used} conditions -> {given.out}")


if __name__ == "__main__":
    main()
