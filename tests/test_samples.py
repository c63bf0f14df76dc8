"""Samples of traces: the same whether a table is given or read part by part."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
from bins_helpers import make_bins, make_traces

from sealfit.closure import loop
from sealfit.closure.confirm import Context
from sealfit.closure.ripple_selection import numbered, steady_samples
from sealfit.closure.subsampling import Subsample
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint.rows import make_rows, thin
from sealfit.ingest.stored_parts import StoredTraces, a_part_at_a_time
from sealfit.store import parquet
from sealfit.tables import TRACES
from sealfit.units import Units


def stored(traces: pd.DataFrame, folder, files: list[list[str]]) -> list[StoredTraces]:
    """Write parts of some files each, and say where they are."""
    paths = []
    for number, own in enumerate(files):
        paths.append(folder / f"{number}.parquet")
        part = traces[traces["file"].isin(own)]
        absent = {name: None for name in TRACES.names() if name not in part}
        parquet.write_arrow(parquet.to_arrow(part.assign(**absent), TRACES, Units()), paths[-1])
    return [StoredTraces(frozenset("a"), tuple(paths[:1])), StoredTraces(frozenset("b"), tuple(paths[1:]))]


def test_samples_read_part_by_part_are_those_of_the_whole_table(tmp_path):
    bins = make_bins(directions=(1, -1), repeats=1, bins=5)
    traces = make_traces(bins)
    traces["steady"] = np.arange(len(traces)) % 5 > 0
    rows = make_rows(numbered(bins[bins["file"] != "f0003.csv"]), has_aging=True)  # a file without any bins
    files = sorted(traces["file"].unique())
    whole = steady_samples(traces, rows)
    parts = steady_samples(stored(traces, tmp_path, [files[:2], files[2:3], files[3:]]), rows)
    assert len(whole) == 4 * (len(files) - 1)
    pd.testing.assert_frame_equal(parts, whole)
    assert set(whole["unit"]) == set(range(len(files) - 1))


def test_no_more_than_a_part_is_read_at_once(tmp_path):
    traces = make_traces(make_bins(repeats=1, bins=3))
    files = sorted(traces["file"].unique())
    where = stored(traces, tmp_path, [files[:1], files[1:3], files[3:]])
    assert [len(part) for part in a_part_at_a_time(where, ["file", "force_N"])] == [3, 6, 3 * len(files) - 9]
    assert [list(part) for part in a_part_at_a_time(traces, ["force_N"])] == [["force_N"]]


def test_a_campaign_without_traces_has_no_samples():
    rows = make_rows(numbered(make_bins(repeats=1, bins=3)), has_aging=True)
    samples = steady_samples([], rows)
    assert len(samples) == 0
    assert {"stroke_id", "unit", "direction", "displacement_mm", "time_s", "force_N"} <= set(samples)


def test_a_fold_is_searched_without_its_strokes(monkeypatch):
    bins = numbered(make_bins(repeats=1, bins=6))
    rows, coarse = make_rows(bins, has_aging=True), make_rows(thin(bins, len(bins) // 3), has_aging=True)
    samples = steady_samples(make_traces(bins), rows)
    part, context = Subsample(rows, coarse, coarse), Context(Config(), EFFECTS)
    out = rows.codes("run") % 5 == 0
    used = {}

    def search(train, seen, context, **others):
        used.update(others, train=train, seen=seen)
        return SimpleNamespace(before=None, after=SimpleNamespace(model="model"), added=())

    monkeypatch.setattr(loop, "select_effects", search)
    monkeypatch.setattr(loop, "_predicted", lambda fitted, part, test: (test.force, test.force > 0))
    assert loop._searched(part, samples, context, None, 2, rows.subset(out))[-1] == "model"
    kept = set(rows.table["stroke_id"][~out])
    assert set(used["seen"]["stroke_id"]) == set(used["train"].table["stroke_id"]) == kept
    assert used["train"].force.size == 2 * len(kept)
    assert used["fine"].force.size == 6 * len(kept)
