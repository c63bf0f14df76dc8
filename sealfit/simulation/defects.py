"""Bad data on purpose: what ingest must find, in files that the truth lists."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sealfit.simulation.draws import Draws
from sealfit.simulation.noise import BadData, Noise

Columns = dict[str, np.ndarray]  # a trace's columns, each of shape (n,); NaN is written as an empty cell


def draw_defects(noise: Sequence[Noise], files: int, draws: Draws) -> dict[int, str]:
    """Return which file is spoilt how; no file twice, so fewer where the files run out."""
    wanted = [
        defect
        for kind in noise
        if isinstance(kind, BadData)
        for defect in DEFECTS
        for _ in range(getattr(kind, defect))
    ]
    order = draws.stream("bad_data").permutation(files).tolist()
    return dict(zip(order, wanted, strict=False))


def spoil(columns: Columns, defect: str, random: np.random.Generator) -> Columns:
    """Return a trace's columns with one of `DEFECTS`."""
    return DEFECTS[defect](columns, random)


def _missing_cells(columns: Columns, random: np.random.Generator) -> Columns:
    force = columns["force_N"].copy()
    force[random.choice(len(force), size=max(1, len(force) // 50), replace=False)] = np.nan
    return {**columns, "force_N": force}


def _spikes(columns: Columns, random: np.random.Generator) -> Columns:
    force = columns["force_N"].copy()
    force[random.choice(len(force), size=3, replace=False)] = 10.0 * force[np.argmax(np.abs(force))]
    return {**columns, "force_N": force}


def _gap(columns: Columns, random: np.random.Generator) -> Columns:
    n = len(columns["force_N"])
    first = int(n * random.uniform(0.4, 0.5))
    keep = np.r_[0:first, first + n // 10 : n]
    return {name: values[keep] for name, values in columns.items()}


def _saturated(columns: Columns, random: np.random.Generator) -> Columns:
    force = columns["force_N"]
    limit = 0.97 * np.median(np.abs(force))
    return {**columns, "force_N": np.clip(force, -limit, limit)}


def _reversed(columns: Columns, random: np.random.Generator) -> Columns:
    return {name: values[::-1] for name, values in columns.items()}


DEFECTS: dict[str, Callable[[Columns, np.random.Generator], Columns]] = {
    "missing_cells": _missing_cells,
    "spikes": _spikes,
    "gaps": _gap,
    "saturated": _saturated,
    "reversed": _reversed,
}
