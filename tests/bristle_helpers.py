"""The dynamic LuGre model along any history of the speed, integrated by scipy."""

import numpy as np
from scipy.integrate import solve_ivp

STEPS = 200  # at least, so that a reversal between two output times is resolved


def integrated(time, speed, load, model, *, deflection=0.0):
    """Return force (N) and mean deflection (mm) at rising times; `speed` is a function of the time."""
    share, factor = model.contact.elements(load) if model.contact else (np.ones(1), np.ones(1))

    def limit(v):
        decay = np.exp(-((v / model.v_s) ** 2))
        return load / model.sigma_0 * (model.mu_c + (model.mu_s - model.mu_c) * decay) * factor

    def rate(t, z):
        return speed(t) - abs(speed(t)) * z / limit(speed(t))

    scale = max(float(np.max(limit(0.0))), abs(deflection))
    start = np.full(share.size, float(deflection))
    found = solve_ivp(
        rate, (time[0], time[-1]), start, method="LSODA", t_eval=time, rtol=1e-9, atol=1e-12 * scale,
        lband=0, uband=0, max_step=(time[-1] - time[0]) / STEPS,
    )  # fmt: skip
    assert found.success
    moving = [model.sigma_0 * z + model.sigma_1 * rate(t, z) for t, z in zip(time, found.y.T, strict=True)]
    viscous = model.sigma_2 * np.array([speed(t) for t in time])
    return np.array(moving) @ share + viscous, found.y.T @ share
