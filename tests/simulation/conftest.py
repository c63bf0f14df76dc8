import pandas as pd
import pytest

from sealfit.simulation import Spec, load_truth, simulate, truth_path


@pytest.fixture
def campaign(tmp_path):
    """Write a campaign; give its truth, runs.csv and traces by file."""

    def write(name="c", **spec):
        simulate(Spec(**{"force_decimals": 9, **spec}), tmp_path / name)
        runs = pd.read_csv(tmp_path / name / "runs.csv")
        traces = {file: pd.read_csv(tmp_path / name / file) for file in runs["file"]}
        return load_truth(truth_path(tmp_path / name)), runs, traces

    return write
