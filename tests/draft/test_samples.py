"""The draft of the campaigns in sample_data: what it finds itself, and the one edit a measured rig needs."""

from pathlib import Path

import numpy.testing as npt

from sealfit.config import parse_config
from sealfit.draft import draft
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.reader import read_trace
from sealfit.ingest.runs import list_traces
from sealfit.store.manifest import ConfigCopy

ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "sample_data"


def both(campaign, config, edit=lambda text: text):
    """Return the draft's config, edited, and the one that is kept for the rig."""
    made = draft(SAMPLES / campaign)
    return (
        made,
        parse_config(edit(made.text), "rig.toml"),
        ConfigCopy.at(ROOT / "configs" / config if config else None).parse(),
    )


def read(campaign, config, file):
    return read_trace(SAMPLES / campaign, TraceRef(file, {}), config).table


def test_the_simulated_campaign_needs_no_edit_and_leaves_no_doubt():
    made, ours, theirs = both("simulated", None)
    assert made.doubts == ()
    listing, faults = list_traces(SAMPLES / "simulated", ours)
    expected, _ = list_traces(SAMPLES / "simulated", theirs)
    assert faults == []
    assert list(listing) == list(expected)
    assert len(listing) == 162
    file = listing[0].file
    assert read("simulated", ours, file).equals(read("simulated", theirs, file))


def pressure_taken_off(text):
    """Replace the force by what is left of it without the pressure: only who knows the rig can say this."""
    return text.replace(
        "\nforce_N = 7\n",
        "\npressure_bar = 6\npiston_force_N = 7\n[trace.constants]\nbore_m = 0.0257\n[trace.compute]\n"
        'force_N = "piston_force_N - pressure_bar * 1e5 * pi * (bore_m / 2) ** 2"\n',
    ).replace("[trace.compute]\n# from", "# from")


def test_the_pneumatic_seal_needs_its_force_computed():
    campaign, file = "measured/pneuseal-repeats", "raw/rerun/1_O-ring257_5bar.csv"
    made, ours, theirs = both(campaign, "pneuseal.toml", pressure_taken_off)
    assert made.files == 20
    assert made.motion == "about 20 strokes in a file, both ways"
    found, expected = read(campaign, ours, file), read(campaign, theirs, file)
    for name in ("time_s", "displacement_mm", "force_N"):  # that config drops the first 15 rows
        npt.assert_allclose(found[name][-len(expected) :], expected[name], rtol=1e-15)
    listing, faults = list_traces(SAMPLES / campaign, ours)
    assert [fault for fault in faults if fault.severity == "error"] == []
    assert len(listing) == 20
    assert {ref.channels["pressure_bar"] for ref in listing} == {1.0, 3.0, 5.0, 7.0}
    assert {ref.channels["repeat"] for ref in listing} == {1, 2, 3}


def test_the_screw_drives_need_the_torque_in_mN_m():
    campaign, file = "measured/screwdrive", "raw/driveNo3/steady_state/0.096kg/n20.csv"
    made, ours, theirs = both(campaign, "screwdrive.toml")
    listing, faults = list_traces(SAMPLES / campaign, ours)
    expected, _ = list_traces(SAMPLES / campaign, theirs)
    assert [fault for fault in faults if fault.severity == "error"] == []
    assert {ref.file for ref in listing} == {ref.file for ref in expected}
    for name in ("speed_set_mm_s", "started_at"):
        assert {ref.file: ref.channels[name] for ref in listing} == {
            ref.file: ref.channels[name] for ref in expected
        }
    found, wanted = read(campaign, ours, file), read(campaign, theirs, file)
    last = len(wanted)  # that config drops the first 50 rows
    npt.assert_allclose(found["time_s"][-last:], wanted["time_s"])
    # The authors turned both signs, and the torque is in percent of 9.84 mN m: the edit.
    npt.assert_allclose(-9.84 / 100 * found["force_N"][-last:], wanted["force_N"])
    way = found["displacement_mm"].to_numpy()[-last:]
    npt.assert_allclose(-(way - way[0]), wanted["displacement_mm"], atol=1e-9)
    assert any("is not in a unit of force" in doubt.reason for doubt in made.doubts)
