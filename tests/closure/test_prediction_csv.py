import pytest

from sealfit.closure.prediction_csv import points_of, read_points
from sealfit.errors import RequestError

POINTS = "aging_days,speed_mm_s\n1,5\n4,5\n"


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (POINTS.replace("1,5", '1,"5'), 2, "a quotation mark is left open"),
        (POINTS.replace("speed", '"speed'), 1, "a quotation mark is left open"),
        (POINTS.replace(",", "|"), 1, "is not separated by commas"),
        ("\n" + POINTS + "7\n", 5, "has 1 cells, and there are 2 columns"),
        ("\na,a\n1\n", 2, "column 'a': appears twice"),
        ("20,1.5\n20,2.5\n", 1, "numbers in place of column names"),
    ],
)
def test_points_that_cannot_be_read_are_refused_with_their_line(tmp_path, text, line, said):
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(RequestError, match=said) as caught:
        read_points(tmp_path / "points.csv")
    assert caught.value.line == line


def test_blank_lines_before_and_between_points_are_nothing(tmp_path):
    (tmp_path / "points.csv").write_text("\n" + POINTS.replace("\n4", "\n\n4"))
    assert points_of(read_points(tmp_path / "points.csv"))["aging_days"].tolist() == [1, 4]
