"""Results of the loop benchmark as Markdown for README.md: each figure with its count, bound and target.

An effect is clear where its true-form test has z >= 8, too weak to see where z <= 0.5; between them a power
curve is drawn. A campaign is clear where all its effects are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from counts import bounds

CLEAR, UNSEEN = 8.0, 0.5
RIVALS = ("plain", "boosting", "ebm", "pygam", "pysindy")
ORDER = ("-", "faint", "weak", "medium", "strong")
# The error counts as worse from this ratio of after to before.
WORSE = 1.02
# Largest ratio of the after-error to that of the true form.
NEAR = 1.3
POWER_EDGES = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)


def share(flags: Iterable[bool]) -> str:
    """Return "k of n, x % [low, high]"; "none of this kind" where n is 0."""
    flags = list(flags)
    if not flags:
        return "none of this kind"
    low, high = bounds(sum(flags), len(flags))
    return f"{sum(flags)} of {len(flags)}, {100 * np.mean(flags):.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def clustered(counts: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Return a pooled share and its standard error, campaigns as clusters: (inside, of) of each; NaN if none.

    Ratio estimator: p = sum inside / sum of, and its variance G/(G-1) sum (inside - p of)^2 / (sum of)^2.
    """
    counts = [c for c in counts if c[1]]
    if not counts:
        return float("nan"), float("nan")
    inside, of = np.array(counts, dtype=float).T
    p = inside.sum() / of.sum()
    if len(counts) < 2:
        return float(p), float("nan")
    spread = ((inside - p * of) ** 2).sum() * len(counts) / (len(counts) - 1)
    return float(p), float(np.sqrt(spread) / of.sum())


def coverage(counts: Sequence[tuple[int, int]]) -> str:
    """Return "x % +- se (n intervals, g campaigns)"."""
    p, se = clustered(counts)
    if np.isnan(p):
        return "none of this kind"
    known = [c for c in counts if c[1]]
    return f"{100 * p:.1f} % ± {100 * se:.1f} ({sum(c[1] for c in known)} intervals, {len(known)} campaigns)"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def summarise(records: list[dict]) -> str:
    """Return all tables."""
    nulls = [r for r in records if r["strength"] == "-"]
    effects = [r for r in records if r["strength"] != "-"]
    parts = [
        _made(nulls, effects),
        _figures(nulls, effects),
        _kinds(effects),
        _errors(effects, nulls),
        _times(records),
    ]
    missing = {name: why for r in records for name, why in r["missing"].items()}
    if missing:
        parts.append(
            "Rivals left out: " + "; ".join(f"{name} ({why})" for name, why in sorted(missing.items())) + "."
        )
    return "\n\n".join(parts)


def _made(nulls: list[dict], effects: list[dict]) -> str:
    def words(some: list[dict]) -> str:
        kinds, seeds = {r["kind"] for r in some}, sorted({r["seed"] for r in some})
        large = sum(r["size"] == "large" for r in some)
        files = sorted({r["files"] for r in some})
        span = f"{files[0]} to {files[-1]} files" if files else ""
        ran = f"seeds {seeds[0]} to {seeds[-1]}" if seeds else ""
        return f"{len(some)} campaigns, {len(kinds)} kinds, {ran}, {span}, {large} of them large"

    return f"Nulls: {words(nulls)}. Effects: {words(effects)}."


def clear(record: dict) -> bool:
    """Whether every true effect of a campaign is clear."""
    return bool(record["effects"]) and all(e["z"] >= CLEAR for e in record["effects"])


def right(record: dict) -> bool:
    """Whether all its effects are clear, found, and named right if in the catalogue, and nothing else is."""
    return (
        clear(record)
        and not record["extra"]
        and all(e["grade"] and e["named"] >= e["catalogued"] for e in record["effects"])
    )


def _figures(nulls: list[dict], effects: list[dict]) -> str:
    seen = [e for r in effects for e in r["effects"] if e["z"] >= CLEAR]
    listed = [e for e in seen if e["catalogued"]]
    several = [r for r in effects if len(r["effects"]) > 1 and clear(r)]
    unseen = [r for r in effects if all(e["z"] <= UNSEEN for e in r["effects"])]
    worst = max((r["after"] / r["before"] for r in nulls), default=float("nan"))
    own = [_counted(r) for r in effects]
    sure = [r for r in effects if right(r)]
    quiet = [abs(r["after"] - r["before"]) <= 1e-9 * r["before"] for r in unseen]
    rows = [
        ("nulls with an effect claimed", share(bool(r["claims"]) for r in nulls), "at most 2 of 160"),
        ("nulls called unexplained", share(r["verdict"] == "unexplained" for r in nulls), "-"),
        (f"nulls with held-out after above {WORSE} x before",
         share(r["after"] > WORSE * r["before"] for r in nulls), f"none (largest ratio {worst:.3f})"),
        ("effect campaigns with an effect beyond the true ones", share(r["extra"] > 0 for r in effects),
         "at most 2 %"),
        ("... those whose only extra is a true effect's channel under a wrong quantity left out",
         share(r["extra"] > r["misplaced"] for r in effects), "-"),
        ("clear effects found (channels, level, acts_on, operation)", share(e["grade"] == 2 for e in seen),
         "97 %"),
        ("... or one that this design cannot tell from it", share(e["grade"] > 0 for e in seen), "-"),
        ("clear effects named right, of those in the catalogue", share(e["named"] for e in listed), "90 %"),
        ("... or the same equation under another id", share(e["named_leniently"] for e in listed), "-"),
        ("two or three clear effects: all found",
         share(all(e["grade"] == 2 for e in r["effects"]) for r in several), "90 %"),
        ("... leniently", share(all(e["grade"] > 0 for e in r["effects"]) for r in several), "-"),
        (f"campaigns with all z <= {UNSEEN}: nothing claimed", share(not r["claims"] for r in unseen), "all"),
        ("... and held-out error the same before and after", share(quiet), "all"),
        ("95 % intervals of parameters, clear effects in their true form", coverage(own), "92 to 98 %"),
        ("95 % intervals of predictions, clear effects named right", _inside(sure),
         "92 to 98 %"),
        ("... all effect campaigns", _inside(effects), "-"),
        ("95 % intervals of predictions, nulls", _inside(nulls), "92 to 98 %"),
    ]  # fmt: skip
    return table(("figure", "reached", "must reach"), rows)


def _inside(records: list[dict]) -> str:
    return coverage([(r["inside"], r["points"]) for r in records])


def _counted(record: dict) -> tuple[int, int]:
    own = [p["inside"] for e in record["effects"] if e["z"] >= CLEAR for p in e["parameters"]]
    return sum(own), len(own)


def _kinds(effects: list[dict]) -> str:
    rows = []
    for kind, some in _grouped(effects, lambda r: r["kind"]):
        cells = [kind]
        for strength in ORDER[1:]:
            own = [e for r in some if r["strength"] == strength for e in r["effects"]]
            if not own:
                cells.append("-")
                continue
            z = sorted(e["z"] for e in own)
            cells.append(
                f"z {z[0]:.1f} to {z[-1]:.1f}: found {sum(e['grade'] == 2 for e in own)}+"
                f"{sum(e['grade'] == 1 for e in own)}, named {sum(e['named'] for e in own)} of {len(own)}"
            )
        others = [e["claimed_id"] for r in some for e in r["effects"] if e["claimed_id"] and not e["named"]]
        rows.append([*cells, str(sum(r["extra"] for r in some)), ", ".join(sorted(set(others))) or "-"])
    header = ("kind (found: strictly + leniently)", *ORDER[1:], "extra", "other names given")
    return table(header, rows)


def _errors(effects: list[dict], nulls: list[dict]) -> str:
    """Return the error of the mean force at unseen points, RMS over seeds of each kind and strength, in N."""
    rows, near, least = [], [], []
    every = sorted(effects, key=lambda r: (r["kind"], ORDER.index(r["strength"]))) + sorted(
        nulls, key=lambda r: r["kind"]
    )
    for (kind, strength), some in _grouped(every, lambda r: (r["kind"], r["strength"])):
        both = [
            r for r in some if all(name in r["errors"] for name in ("boosting", "ebm", "pygam", "pysindy"))
        ]
        whole = {name: _root(some, name) for name in ("after", "true_form")}
        own = {name: _root(both or some, name) for name in ("after", *RIVALS)}
        others = {name: own[name] for name in RIVALS if np.isfinite(own[name])}
        ratio = whole["after"] / whole["true_form"]
        best = min(others, key=others.get)
        if strength != "-":
            near.append(ratio <= NEAR)
            least.append(own["after"] <= others[best] * (1 + 1e-9))
        named = [f"{own[name]:.3f}" if np.isfinite(own[name]) else "-" for name in RIVALS]
        mark = "" if ratio <= NEAR else " **"
        rows.append(
            (kind, strength, f"{whole['after']:.3f}", f"{whole['true_form']:.3f}", f"{ratio:.2f}{mark}",
             *named, "" if own["after"] <= others[best] * (1 + 1e-9) else best)
        )  # fmt: skip
    header = ("kind", "strength", "after", "true form", "ratio", *RIVALS, "better than after")
    lead = (
        f"Error of `predict` against the noise-free force at {200} unseen points, RMS over seeds, N. "
        f"After at most {NEAR} x the true form: {share(near)} of kinds and strengths; "
        f"no alternative below it: {share(least)}."
    )
    return lead + "\n\n" + table(header, rows)


def _root(records: list[dict], name: str) -> float:
    values = [r["errors"][name] for r in records if name in r["errors"]]
    return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")


def _grouped(records: list[dict], by: Callable[[dict], object]) -> list[tuple]:
    groups: dict = {}
    for record in records:
        groups.setdefault(by(record), []).append(record)
    return list(groups.items())


def _times(records: list[dict]) -> str:
    names = list(dict.fromkeys(name for r in records for name in r["seconds"] if name != "wall"))
    rows = []
    for size, some in _grouped(records, lambda r: r["size"]):
        own = {name: [r["seconds"][name] for r in some if name in r["seconds"]] for name in names}
        cells = [f"{np.mean(v):.1f} (at most {max(v):.0f})" if v else "-" for v in own.values()]
        total = sum(sum(v) for v in own.values())
        rows.append((size, str(len(some)), *cells, f"{total / 60:.0f} min"))
    lead = (
        "CPU seconds of a campaign by part, mean and most; "
        "the last column is the sum over campaigns, one core."
    )
    return lead + "\n\n" + table(("size", "campaigns", *names, "sum"), rows)


def draw_power(records: list[dict], path: Path) -> None:
    """Draw the share of effects found over z, with Clopper-Pearson bars, to a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    found = [(e["z"], e["grade"] > 0) for r in records for e in r["effects"] if UNSEEN < e["z"] < CLEAR]
    figure, ax = plt.subplots(figsize=(5, 3.4), layout="constrained")
    for low, high in pairwise(POWER_EDGES):
        own = [hit for z, hit in found if low <= z < high]
        if own:
            share_, (least, most) = float(np.mean(own)), bounds(sum(own), len(own))
            ax.errorbar(
                (low + high) / 2,
                share_,
                [[share_ - least], [most - share_]],
                (high - low) / 2,
                fmt="o",
                color="C0",
            )
            ax.annotate(f"{len(own)}", ((low + high) / 2, 1.03), ha="center", fontsize=8)
    ax.set(
        xlabel="z of the true-form test", ylabel="share of effects found", xlim=(0, CLEAR), ylim=(-0.05, 1.12)
    )
    figure.savefig(path, dpi=150)
    plt.close(figure)
