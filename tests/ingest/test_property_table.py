"""Tables of properties for `fit-aging --values`: what is read, and how faults are said."""

import pytest

from sealfit.config import Config, parse_config
from sealfit.errors import CampaignError
from sealfit.ingest.property_table import read_properties

PLAIN = "aging_days,temperature_C,hardness\n0,23,60\n2,70,58\n4,70,57\n"


def read(tmp_path, text, config=None, **asked):
    path = tmp_path / "values.csv"
    path.write_text(text, "utf-8")
    return read_properties(path, config or Config(), **asked)


def test_a_plain_table_needs_no_config(tmp_path):
    table, faults = read(tmp_path, PLAIN)
    assert not faults
    assert table["quantity"].unique().tolist() == ["hardness"]
    assert table["condition"].tolist() == [
        "unaged",
        "temperature_C=70, aging_days=2",
        "temperature_C=70, aging_days=4",
    ]
    assert table["line"].tolist() == [2, 3, 4]


def test_decimal_commas_words_for_unaged_and_another_column_for_the_batch(tmp_path):
    text = "aging_days;temperature_C;lot;hardness\nfresh;RT;7;60,5\n2;70;7;58,25\n4;70;8;57\n"
    table, _ = read(tmp_path, text, batch="lot")
    assert table["value"].tolist() == [60.5, 58.25, 57.0]
    assert table["batch"].tolist() == ["7", "7", "8"]
    assert table["condition"].iloc[0] == "unaged"


def test_names_units_and_computed_columns_are_those_of_the_config(tmp_path):
    config = parse_config(
        '[files.runs_columns]\naging_days = {name = "h", unit = "h"}\n'
        'temperature_C = {name = "F", unit = "degF"}\n'
        '[runs]\ncompute = {strength = "_peak / _area"}\n'
        '[files.runs_columns._peak]\nname = "peak"\n[files.runs_columns._area]\nname = "area"\n',
        "own.toml",
    )
    table, _ = read(tmp_path, "h,F,peak,area\n0,73.4,90,2\n48,158,80,2\n", config)
    assert table["quantity"].unique().tolist() == ["strength"]
    assert table["value"].tolist() == [45.0, 40.0]
    assert table["aging_days"].tolist() == [0.0, 2.0]
    assert table["temperature_C"].iloc[1] == 70.0


def test_title_lines_above_the_header_are_passed_over(tmp_path):
    text = "Report 2009;;\n;;\naging_days;temperature_C;hardness\n0;RT;60,5\n2;70;58\n4;70;soft\n"
    with pytest.raises(CampaignError, match=r":6: column 'hardness': 'soft'"):
        read(tmp_path, text)
    table, _ = read(tmp_path, text.replace("soft", "57"))
    assert table["value"].tolist() == [60.5, 58.0, 57.0]
    assert table["line"].tolist() == [4, 5, 6]


def test_a_merged_title_of_a_workbook_is_passed_over(tmp_path):
    book = pytest.importorskip("openpyxl").Workbook()
    for row in (["Report 2009"], ["aging_days", "hardness"], [0, 60], [2, 58]):
        book.active.append(row)
    book.active.merge_cells("A1:C1")
    book.save(tmp_path / "values.xlsx")
    table, _ = read_properties(tmp_path / "values.xlsx", Config())
    assert table["value"].tolist() == [60.0, 58.0]
    book.active.merge_cells("A3:A4")
    book.save(tmp_path / "values.xlsx")
    with pytest.raises(CampaignError, match="A3:A4 are merged"):
        read_properties(tmp_path / "values.xlsx", Config())


def test_a_row_without_a_value_is_left_out_and_said(tmp_path):
    table, faults = read(tmp_path, PLAIN + "8,70,\n16,70,n/a\n32,70,-9999.0\n")
    assert len(table) == 3
    (fault,) = faults
    assert (fault.line, fault.action, fault.severity) == (5, "row left out", "warning")
    assert fault.reason == "3 rows have no value and are left out: 5, 6, 7."


def test_a_column_that_looks_like_that_of_the_batch_is_named(tmp_path):
    _, faults = read(tmp_path, "aging_days,batchs,hardness\n0,A,60\n2,B,58\n")
    assert [(fault.column, fault.reason) for fault in faults] == [
        ("batchs", "is not used; it looks like 'batch'.")
    ]


def test_several_properties_are_named(tmp_path):
    text = "aging_days,hardness,strength\n0,60,20\n2,58,18\n"
    with pytest.raises(CampaignError, match=r"hardness, strength.*--property COLUMN"):
        read(tmp_path, text)
    table, _ = read(tmp_path, text, properties=("strength, hardness,",))
    assert sorted(set(table["quantity"])) == ["hardness", "strength"]


@pytest.mark.parametrize(
    ("text", "asked", "said"),
    [
        ("", {}, "is empty"),
        ("aging_days,hardness\n", {}, "no rows"),
        ("days,hardness\n1,2\n", {}, r"values\.csv: column 'aging_days'.*files\.runs_columns"),
        (
            "aging_days,temperature_C,hardness\n0,23,60\n2,n/a,58\n",
            {},
            r":3: column 'temperature_C'.*holds no value: .*n/a",
        ),
        ("aging_days,hardness\n0,60\nsoon,58\n", {}, r":3: column 'aging_days'.*'soon'.*not a number"),
        ("aging_days,hardness\n0,60\n-2,58\n", {}, r":3: column 'aging_days'"),
        ("aging_days,hardness\n0,60\n0,58\n", {}, "no value of an aged specimen"),
        ("aging_days,words\n0,good\n2,bad\n", {}, "no column of a property"),
        ("aging_days,hardness\n0,60\n2,58\n", {"properties": ("hardnes",)}, "Did you mean 'hardness'"),
        ("aging_days,hardness\n0,60\n2,58\n", {"batch": "lot"}, "column 'lot'"),
        ("aging_days,hardness,hardness\n0,60,1\n2,58,1\n", {}, "2 times in the header"),
        ("aging_days,hardness\n0,60,5\n2,58,1\n", {}, "3 cells where 2 are named"),
    ],
)
def test_what_cannot_be_read_is_one_line_with_its_place(tmp_path, text, asked, said):
    with pytest.raises(CampaignError, match=said):
        read(tmp_path, text, **asked)
