import numpy as np
import numpy.testing as npt
import pytest
from trace_helpers import HEADER, ROWS, changed, config, csv_of

from sealfit.errors import BadFile
from sealfit.ingest.file_names import TraceRef
from sealfit.ingest.files import read_bytes
from sealfit.ingest.reader import Trace, read_trace, read_traces

WITH_CHANNEL = [f"{row},{20 + i % 3}" for i, row in enumerate(ROWS)]
WITH_GAPS = [*WITH_CHANNEL[:7], f"{ROWS[7]},", *WITH_CHANNEL[8:]]
FILES = {
    "plain": csv_of(ROWS),
    "short": csv_of(ROWS[:40]),
    "no last line end": csv_of(ROWS).rstrip("\n"),
    "empty cell": changed(10, "1.0,,2.0"),
    "nan": changed(10, "1.0,5.0,nan"),
    "text": changed(10, "1.0,5.0,abc"),
    "few cells": changed(10, "1.0,5.0"),
    "many cells": changed(10, "1.0,5.0,2.1,7"),
    "blank line": csv_of([*ROWS[:10], "", *ROWS[10:]]),
    "open quote": changed(10, '1.0,5.0,"2.1'),
    "quoted line end": changed(10, '1.0,5.0,"2.1\n"'),
    "windows": csv_of(ROWS).replace("\n", "\r\n"),
    "byte-order mark": "\ufeff" + csv_of(ROWS),
    "overload": changed(10, "1.0,5.0,9.9e37"),
    "time": changed(10, "0.3,5.0,2.0"),
    "separators only": csv_of([",,"] * 9),
    "header only": HEADER + "\n",
    "cut header": HEADER,
    "other order": csv_of([",".join(row.split(",")[::-1]) for row in ROWS], "force_N,displacement_mm,time_s"),
    "channel": csv_of(WITH_CHANNEL, HEADER + ",lab_C"),
    "channel of text": csv_of([f"{row},warm" for row in ROWS], HEADER + ",lab_C"),
    "channel with gaps": csv_of(
        [row if i != 7 else f"{ROWS[7]}," for i, row in enumerate(WITH_CHANNEL)], HEADER + ",lab_C"
    ),
    "column without name": csv_of([f"{row}," for row in ROWS]),
    "remarks beside the numbers": csv_of([f"{row},?" for row in ROWS]),
    "binary": "PK\x03\x04",
}


@pytest.mark.parametrize("text", ["", 'trace.delimiter = "tab"', 'trace.delimiter = "whitespace"'])
def test_files_read_together_are_as_each_is_read_alone(tmp_path, text):
    mark = "\t" if text else ","
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content.replace(",", mark).encode())
    refs = [TraceRef(name, {"speed_set_mm_s": 5.0}) for name in (*FILES, *FILES) if name != "binary"]
    found = read_traces([(ref, read_bytes(tmp_path, ref.file)) for ref in refs], config(text))
    assert sum(isinstance(made, Trace) for made in found) >= 20
    for ref, made in zip(refs, found, strict=True):
        if isinstance(made, BadFile):
            with pytest.raises(BadFile) as caught:
                read_trace(tmp_path, ref, config(text))
            assert caught.value.faults == made.faults
            continue
        alone = read_trace(tmp_path, ref, config(text))
        assert made.faults == alone.faults
        assert made.rows_read == alone.rows_read
        npt.assert_array_equal(made.line, alone.line)
        assert list(made.columns) == list(alone.columns)
        for name, values in made.columns.items():
            assert values.dtype == alone.columns[name].dtype
            npt.assert_array_equal(values, alone.columns[name])


def test_whole_numbers_of_any_size_are_a_channel(tmp_path):
    big = 2**60 + 1
    (tmp_path / "t.csv").write_text(
        csv_of([f"{row},{big + i}" for i, row in enumerate(ROWS)], HEADER + ",count")
    )
    npt.assert_array_equal(
        read_trace(tmp_path, TraceRef("t.csv", {}), config()).columns["count"], np.float64(big)
    )
