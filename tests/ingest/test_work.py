"""Work that must grow with the campaign and not with its square, counted; less of it gives the same."""

import numpy as np
import pandas as pd

from sealfit.ingest import repeat_checks
from sealfit.ingest.files import inside
from sealfit.ingest.listing import files_beside

HEAD = "file,run_id,repeat,temperature_C,compression_ratio_pct,aging_days,load_N,speed_mm_s,started_at"


def counted(monkeypatch, module, name):
    """Count the calls of a module's function from here on."""
    calls, function = [], getattr(module, name)
    monkeypatch.setattr(
        module, name, lambda *given, **named: (calls.append(given), function(*given, **named))[1]
    )
    return calls


def test_what_lies_inside_is_told_by_following_every_link(tmp_path):
    place, outside = tmp_path / "campaign", tmp_path / "outside"
    for folder in (place / "traces" / "deep", outside):
        folder.mkdir(parents=True)
        (folder / "a.csv").write_text("")
    (place / "b.csv").write_text("")
    (place / "C:").mkdir()
    (place / "C:" / "a.csv").write_text("")
    (place / "out.csv").symlink_to(outside / "a.csv")
    (place / "in.csv").symlink_to(place / "b.csv")
    (place / "out").symlink_to(outside)
    (place / "in").symlink_to(place / "traces")
    (place / "self").symlink_to(place)
    (place / "loop").symlink_to(place / "loop")
    there = ["b.csv", "in.csv", "traces/deep/a.csv", "traces/deep/none.csv", "none/a.csv", "in/deep/a.csv",
             "self/b.csv", "traces", "b.csv/a.csv"]  # fmt: skip
    away = ["out.csv", "out/a.csv", "self", "loop", "loop/a.csv", "..", "../outside/a.csv", ".",
            str(place / "b.csv"), "C:/a.csv", "\\\\host\\a.csv", ""]  # fmt: skip
    assert [inside(place, file) for file in there] == [place / file for file in there]
    assert [inside(place, file) for file in away] == [None] * len(away)


def test_files_beside_have_an_ending_of_the_listed_and_are_files(tmp_path):
    for name in ("a.csv", "b.csv", "c.txt", ".csv", "t/d.csv", "t/e.CSV", "other/f.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "link.csv").symlink_to(tmp_path / "c.txt")
    (tmp_path / "broken.csv").symlink_to(tmp_path / "none")
    assert files_beside(tmp_path, {"a.csv", "t/none.csv", "gone/x.csv"}) == {"b.csv", "link.csv", "t/d.csv"}
    assert files_beside(tmp_path / "none", {"a.csv"}) == set()


def test_strokes_with_turned_signs_are_not_each_compared_with_all(monkeypatch):
    looked = counted(monkeypatch, np, "median")
    strokes = pd.DataFrame(
        {"file": [f"{k}.csv" for k in range(60)], "run": [f"r{k // 3}" for k in range(60)], "stroke": 1,
         "several": False, "direction": 1, "force_N": [-20.0] * 59 + [20.0], "used": True}
    )  # fmt: skip
    keep, found = repeat_checks.reversed_strokes(strokes)
    assert (keep.all(), len(found), len(looked)) == (True, 59, 0)


def test_a_turned_stroke_is_held_against_the_median_of_its_mates():
    forces = [
        20.0,
        22.0,
        -21.0,
        24.0,
        30.0,
        -9.0,
    ]  # of the second run two: held against all others of the direction
    strokes = pd.DataFrame(
        {"file": list("abcdef"), "stroke": 1, "several": False, "run": ["x"] * 4 + ["y"] * 2, "direction": 1,
         "force_N": forces, "used": True}
    )  # fmt: skip
    keep, found = repeat_checks.reversed_strokes(strokes)
    # -21 against the median 22 of 20, 22, 24; -9 against the median 22 of 20, 22, -21, 24, 30: not below -11.
    assert keep.tolist() == [True, True, False, True, True, True]
    assert [fault.severity for fault in found] == ["error", "warning"]
