import numpy as np
import numpy.testing as npt
import pytest
from bristle_helpers import integrated
from simulation_helpers import ONE_CONDITION

from sealfit.physics import LuGre

MODEL = {"mu_s": 0.8, "mu_c": 0.5, "v_s": 5.0, "sigma_0": 60.0, "sigma_1": 0.3, "sigma_2": 0.05}
PHYSICS = {
    "mu_s": {"mu_0": MODEL["mu_s"]}, "mu_c": {"mu_0": MODEL["mu_c"]},
    **{name: MODEL[name] for name in ("v_s", "sigma_0", "sigma_1", "sigma_2")},
}  # fmt: skip


@pytest.mark.parametrize("speed", [1.0, 20.0])
@pytest.mark.parametrize("design", [{}, {"directions": (1, -1), "strokes_per_file": 2}])
def test_traces_follow_the_dynamic_model_through_the_ramps(campaign, speed, design):
    rig = {**ONE_CONDITION, "speeds_mm_s": (speed,), "max_rows": 2000, **design}
    _, runs, traces = campaign(design=rig, physics=PHYSICS)
    trace = traces[runs["file"][0]]
    t, force = trace["time_s"].to_numpy(), trace["force_N"].to_numpy()
    length, ramp, rest = 40.0, min(0.2, 4.0 / speed), min(0.5, 4.0 / speed)
    cruise = length / speed - ramp
    period = rest + 2 * ramp + cruise

    def along(now):
        number = min(now // period, rig.get("strokes_per_file", 1) - 1)
        since = now - number * period - rest
        size = np.interp(since, [0.0, ramp, ramp + cruise, 2 * ramp + cruise], [0.0, speed, speed, 0.0])
        return size * (-1.0) ** number

    exact, _ = integrated(t, along, 49.03, LuGre(**MODEL))
    npt.assert_allclose(force, exact, atol=0.002 * exact.max())
