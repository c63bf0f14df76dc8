import numpy as np
import numpy.testing as npt
import pytest
from trace_helpers import config

from sealfit.ingest.file_names import TraceRef
from sealfit.ingest.stroke_means import read_strokes


def stroke_file(folder, file, *, strokes=1, rows=300, resolution=0.0, spoil=None, channel=None):
    """A trace that goes to and fro over 40 mm, with a pre-sliding rise at the start of every stroke."""
    rng = np.random.default_rng(len(file) * rows + strokes)
    place = np.arange(rows * strokes) / rows
    way, along = np.where(place % 2 < 1, 1.0, -1.0), 40.0 * (place % 1.0)
    x = np.where(way > 0, along, 40.0 - along) + rng.normal(0.0, 0.002, len(place))
    force = way * 30.0 * (1.0 - np.exp(-along / 0.5)) + rng.normal(0.0, 0.2, len(place))
    if resolution:
        force = resolution * np.round(force / resolution)
    if spoil is not None:
        spoil(x, force)
    columns = [8.0 * place, x, force, *([] if channel is None else [np.full(len(place), channel)])]
    lines = [",".join(str(value) for value in row) for row in zip(*columns, strict=True)]
    head = "time_s,displacement_mm,force_N" + ("" if channel is None else ",oil")
    (folder / file).write_text("\n".join([head, *lines]) + "\n")


def force_spike(x, force):
    force[[70, 150]] += 90.0


def displacement_spike(x, force):
    x[90] += 4.0


def stuck(x, force):
    force[100:180] = force[100]


def constant(x, force):
    force[:] = 7.5


def still(x, force):
    x[:] = 5.0


@pytest.fixture
def refs(tmp_path):
    kinds = (None, force_spike, displacement_spike, stuck, constant, still)
    for number, spoil in enumerate(kinds):
        stroke_file(tmp_path, f"{number}.csv", spoil=spoil)
        stroke_file(tmp_path, f"{number}_several.csv", spoil=spoil, strokes=5, rows=200)
    stroke_file(tmp_path, "coarse.csv", resolution=0.5, rows=900)
    stroke_file(tmp_path, "short.csv", rows=25)
    stroke_file(tmp_path, "oil.csv", channel=20.5)
    stroke_file(tmp_path, "label.csv", channel="warm")
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "text.csv").write_text("time_s,displacement_mm,force_N\n" + "a,b,c\n" * 30)
    files = [*sorted(path.name for path in tmp_path.glob("*.csv")), "missing.csv"]
    return [TraceRef(file, {"run_id": file, "speed_set_mm_s": 5.0}) for file in files]


def test_files_read_together_give_what_each_gives_alone(tmp_path, refs):
    found = read_strokes(refs, tmp_path, config())
    assert {fault.check for made in found for fault in made.faults} >= {
        "spike",
        "stuck",
        "no_motion",
        "empty_file",
    }
    for ref, made in zip(refs, found, strict=True):
        (alone,) = read_strokes([ref], tmp_path, config())
        assert (made.file, made.mark, made.rows, made.faults) == (
            alone.file,
            alone.mark,
            alone.rows,
            alone.faults,
        )
        assert len(made.strokes) == len(alone.strokes)
        for ours, theirs in zip(made.strokes, alone.strokes, strict=True):
            assert list(ours) == list(theirs)
            for name, value in ours.items():
                if isinstance(value, float):
                    npt.assert_allclose(value, theirs[name], rtol=1e-12)
                else:
                    assert value == theirs[name]
        assert (made.samples is None) == (alone.samples is None)
        for name, values in (made.samples or {}).items():
            npt.assert_array_equal(values, alone.samples[name])
