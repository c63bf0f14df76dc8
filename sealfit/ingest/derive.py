"""What runs.csv leaves out: conditions in words, runs, repeats, specimens, the order of the campaign.

Everything here works on what is already known of each file, and reads none.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from datetime import UTC, datetime

import pandas as pd

from sealfit.conditions import add_keys, condition_columns
from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.runs_csv import Entry

Channels = dict[str, float | str]
SAME_SPEED = 0.05  # measured speeds closer than this share are one commanded speed; rigs repeat within a few percent


def condition_keys(files: Sequence[Channels], config: Config) -> list[str]:
    """Return the condition of each file in words, as `conditions.add_keys` spells it.

    Examples
    --------
    >>> condition_keys([{"temperature_C": 60.0, "compression_ratio_pct": 80.0, "aging_days": 4.0}], Config())
    ['temperature_C=60, compression_ratio_pct=80, aging_days=4']
    >>> condition_keys([{"aging_days": 0.0}], Config())
    ['unaged']
    """
    names = condition_columns(config)
    own = [tuple([channels.get(name) for name in names]) for channels in files]
    different = dict.fromkeys(own)  # far fewer than there are files
    columns = zip(*different, strict=True) if different else [()] * len(names)
    table = pd.DataFrame({name: pd.Series(list(c), dtype=object) for name, c in zip(names, columns, strict=True)})
    words = dict(zip(different, add_keys(table, config)["condition"].tolist(), strict=True))
    return [words[key] for key in own]


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def add_order(entries: Sequence[Entry], files: Sequence[Channels]) -> tuple[list[Channels], list[Fault]]:
    """Return the files with `run_order` and `elapsed_h` where they say when they were started, and faults of bad times.

    Equal times share the order of the first of them. A time without a zone is taken as UTC, so that one campaign
    with and without zones keeps one order.
    """
    faults, times = [], {}
    for i, (entry, channels) in enumerate(zip(entries, files, strict=True)):
        if "started_at" not in channels:
            continue
        text = str(channels["started_at"]).strip()
        try:
            times[i] = datetime.fromisoformat(text)
        except ValueError:
            mend = "Write it as 2024-03-01T09:30:00."
            faults.append(entry.fault("not_a_time", "is no ISO 8601 time.", "started_at", value=text, mend=mend))
    if any(time.tzinfo for time in times.values()):
        times = {i: time if time.tzinfo else time.replace(tzinfo=UTC) for i, time in times.items()}
    ordered = sorted(times.values())
    first: dict[datetime, int] = {}
    for place, time in enumerate(ordered, start=1):
        first.setdefault(time, place)
    added = list(files)
    for i, time in times.items():
        hours = (time - ordered[0]).total_seconds() / 3600
        added[i] = {**files[i], "run_order": float(first[time]), "elapsed_h": hours}
    return added, faults


def add_specimens(files: Sequence[Channels], conditions: Sequence[str]) -> list[Channels]:
    """Return the files with a `specimen_id`: one per condition where none is named."""
    return [
        channels if "specimen_id" in channels else {"specimen_id": condition, **channels}
        for channels, condition in zip(files, conditions, strict=True)
    ]


def add_runs(
    files: Sequence[Channels],
    conditions: Sequence[str],
    speeds: Sequence[float | None],
    measured: Sequence[float],
    unit: str,
) -> tuple[list[Channels], list[Fault]]:
    """Return the files with a `run_id`, and what is to be said of it.

    Where none is given there is one per condition, commanded speed and (named) specimen.

    Parameters
    ----------
    files : sequence of dict
        Channels of each file.
    conditions : sequence of str
        Condition of each file in words.
    speeds : sequence of float or None
        Commanded speeds, signed where a sign was given.
    measured : sequence of float
        Measured speeds, read where no speed is commanded (else nan): files within 5 % share a run.
    unit : str
        Unit of the speeds.
    """
    run_ids = {i: channels["run_id"] for i, channels in enumerate(files) if "run_id" in channels}
    groups = defaultdict(list)
    for i in range(len(files)):
        if i in run_ids:
            continue
        words = [conditions[i]]
        if "specimen_id" in files[i]:
            words.append(str(files[i]["specimen_id"]))
        if speeds[i] is not None:
            run_ids[i] = ", ".join([*words, f"{speeds[i]:g} {unit}"])
        else:
            groups[", ".join(words)].append(i)
    for words, members in groups.items():
        members.sort(key=lambda i: measured[i])
        cluster: list[int] = []
        for place, i in enumerate(members):
            cluster.append(i)
            after = members[place + 1] if place + 1 < len(members) else None
            if after is None or not measured[after] <= measured[i] * (1 + SAME_SPEED):
                middle = measured[cluster[len(cluster) // 2]]
                name = words if math.isnan(middle) else f"{words}, about {middle:.3g} {unit}"
                run_ids.update(dict.fromkeys(cluster, name))
                cluster = []
    added = [c if "run_id" in c else {**c, "run_id": run_ids[i]} for i, c in enumerate(files)]
    if not groups:
        return added, []
    reason = "neither run_id nor a commanded speed is given; files of one condition share a run within 5 % of speed."
    said = Fault("run_id_derived", reason, severity="info", action="kept", mend="Give run_id or speed_mm_s.")
    return added, [said]


def add_repeats(files: Sequence[Channels]) -> list[Channels]:
    """Return the files with a `repeat`: where missing by `started_at` if the whole run has it, else by file order."""
    if all("repeat" in channels for channels in files):
        return list(files)
    runs = defaultdict(list)
    for i, channels in enumerate(files):
        runs[channels["run_id"]].append(i)
    numbers = {}
    for members in runs.values():
        if all("elapsed_h" in files[i] for i in members):
            members.sort(key=lambda i: (files[i]["elapsed_h"], i))
        used = {files[i]["repeat"] for i in members if "repeat" in files[i]}
        free = (number for number in range(1, len(members) + len(used) + 1) if number not in used)
        numbers.update({i: next(free) for i in members if "repeat" not in files[i]})
    return [{**channels, "repeat": channels.get("repeat", numbers.get(i))} for i, channels in enumerate(files)]


def disagreements(
    entries: Sequence[Entry], files: Sequence[Channels], conditions: Sequence[str], speeds: Sequence[float | None]
) -> list[Fault]:
    """Return faults of runs: a repeat that stands twice, or differs from its run in condition, speed or load."""
    faults = []
    first: dict[object, int] = {}
    seen: dict[tuple, int] = {}
    for i, (entry, channels) in enumerate(zip(entries, files, strict=True)):
        run, repeat = channels["run_id"], channels["repeat"]
        if (run, repeat) in seen:
            other = entries[seen[run, repeat]]
            reason = f"repeat {repeat} of run '{run}' is there already: {_place(other)}."
            mend = "Give every file of a run its own repeat number."
            faults.append(entry.fault("duplicate_repeat", reason, "repeat", value=repeat, mend=mend))
        seen.setdefault((run, repeat), i)
        j = first.setdefault(run, i)
        if i == j:
            continue
        pairs = (
            ("speed_mm_s", speeds[i], speeds[j]),
            ("load_N", channels.get("load_N"), files[j].get("load_N")),
            ("condition", conditions[i], conditions[j]),
        )
        for column, mine, theirs in pairs:
            if mine != theirs and not _same(mine, theirs):
                there = "none" if theirs is None else _text(theirs)
                reason = f"differs from the other repeats of run '{run}', {_place(entries[j])}: {there}."
                mend = "One run is one condition, speed and load: give it another run_id, or correct the cell."
                value = "none" if mine is None else mine
                faults.append(entry.fault("run_disagrees", reason, column, value=value, mend=mend))
        if channels["specimen_id"] != files[j]["specimen_id"] and _same(speeds[i], speeds[j]):
            reason = f"run '{run}' has repeats on several specimens; their scatter counts as that of repeats."
            place = {"severity": "warning", "action": "kept", "mend": "Give each specimen a run_id of its own."}
            faults.append(entry.fault("run_specimens", reason, "specimen_id", value=channels["specimen_id"], **place))
    return faults


def _place(entry: Entry) -> str:
    return f"line {entry.line}" if entry.line is not None else entry.file


def _same(a: float | str | None, b: float | str | None) -> bool:
    if isinstance(a, int | float) and isinstance(b, int | float):
        return math.isclose(a, b, rel_tol=1e-9)
    return a == b
