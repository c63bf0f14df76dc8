"""The quick look at all traces at once must not miss a spike that the long look at one would find."""

import numpy as np
import pytest

from sealfit.config import Quality, Strokes
from sealfit.ingest.segments import Pieces
from sealfit.ingest.strokes import displacement_noises_mm, find_all
from sealfit.ingest.trace_checks import displacement_spikes, displacement_suspects, force_spikes, force_suspects


def traces(seed, count=40):
    """Short and long traces with a break-away, noise from none to much, and in half of them a few wrong samples."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(count):
        time = 0.05 * np.arange(rng.integers(20, 400))
        x = 5.0 * time + rng.choice([0.0, 0.002, 0.05]) * rng.normal(size=len(time))
        x = np.where(rng.random() < 0.3, np.abs(x - x.mean()), x)
        force = 20.0 * (1.0 - np.exp(-x / 0.1)) + 8.0 * np.exp(-(((x - 0.5) / 0.2) ** 2))
        force = force + rng.choice([0.0, 0.01, 0.3]) * rng.normal(size=len(time))
        for values in (x, force) if k % 2 else ():
            wrong = rng.choice(len(time), rng.integers(1, 4), replace=False)
            values[wrong] += rng.choice([0.02, 0.3, 5.0, -40.0], len(wrong))
        made.append((time, x, force))
    return made


@pytest.mark.parametrize("seed", range(10))
def test_every_trace_with_a_spike_is_a_suspect(seed):
    made, settings = traces(seed), Quality()
    where = Pieces([len(time) for time, _, _ in made])
    time, x, force = (np.concatenate(parts) for parts in zip(*made, strict=True))
    found = find_all(time, x, force, where, Strokes())
    suspected = displacement_suspects(x, where, displacement_noises_mm(x, where), settings)
    doubted = force_suspects(force, found.steady, where, settings)
    spikes = {"displacement": 0, "force": 0}
    for i, own in enumerate(where.slices):
        line = np.arange(own.stop - own.start)
        strokes = found.of_trace(i, own.start)
        if displacement_spikes("f.csv", x[own], line, settings)[1]:
            assert suspected[i]
            spikes["displacement"] += 1
        if force_spikes("f.csv", force[own], strokes, line, settings)[1]:
            assert doubted[i]
            spikes["force"] += 1
    assert min(spikes.values()) >= 3


def test_the_steep_start_of_a_short_stroke_is_not_looked_at_twice():
    rng = np.random.default_rng(1)
    time = 0.05 * np.arange(80)
    x = 5.0 * (time - 0.2 * (1.0 - np.exp(-time / 0.2)))
    strokes = [(x, 20.0 * (1.0 - np.exp(-x / 0.05)) + 0.05 * rng.normal(size=80)) for _ in range(20)]
    where, (x, force) = Pieces([80] * 20), (np.concatenate(parts) for parts in zip(*strokes, strict=True))
    steady = np.tile(np.arange(80) > 25, 20)
    assert not displacement_suspects(x, where, displacement_noises_mm(x, where), Quality()).any()
    assert not force_suspects(force, steady, where, Quality()).any()
    force[40] += 5.0
    assert force_suspects(force, steady, where, Quality()).tolist() == [True] + [False] * 19
