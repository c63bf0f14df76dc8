"""What must not move when the code is rearranged: ten campaigns, compared with what is on record."""

import json

import pytest
from golden.golden import CAMPAIGNS, RECORDS, differences, record, rounded


@pytest.mark.golden
@pytest.mark.parametrize("name", CAMPAIGNS)
def test_nothing_has_moved(name):
    old = json.loads((RECORDS / f"{name}.json").read_text("utf-8"))
    assert differences(old, json.loads(json.dumps(rounded(record(name))))) == []


def test_differences_are_seen():
    old = {
        "verdict": "closed", "fits": {"mu": [1.0, 0.1]}, "parameters": {}, "errors": {"after rmse_N": 1.0},
        "predictions": [[1.0, 1.0, 0.1, False]],
    }  # fmt: skip
    assert differences(old, old) == []
    moved = {
        **old,
        "fits": {"mu": [1.002, 0.1]},
        "verdict": "unexplained",
        "predictions": [[1.0, 1.1, 0.1, False]],
    }
    assert len(differences(old, moved)) == 3
    assert differences(old, {**old, "fits": {"mu": [1.0005, 0.1]}}) == []
