import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest

from sealfit.closure.spectrum import spectrum_of

LENGTH_MM, A_N, PHASE = 2.5, 0.3, 0.8


def samples_of(strokes):
    """Samples of strokes: (file, direction, first place, step, number of samples); wave, trend and noise."""
    tables, rng = [], np.random.default_rng(5)
    for number, (unit, direction, first, step, count) in enumerate(strokes):
        place = first + step * np.arange(count)
        wave = (
            A_N * np.cos(2 * np.pi * place / LENGTH_MM + PHASE)
            + 3.0
            + 0.1 * place
            + 0.02 * rng.standard_normal(count)
        )
        tables.append(
            pd.DataFrame(
                {
                    "stroke_id": number,
                    "direction": direction,
                    "unit": unit,
                    "displacement_mm": place[::-1] if direction < 0 else place,
                    "time_s": 0.01 * np.arange(count),
                    "residual_N": wave[::-1] if direction < 0 else wave,
                }
            )
        )
    return pd.concat(tables, ignore_index=True)


def many_strokes():
    rng = np.random.default_rng(3)
    return [
        (unit, direction, rng.uniform(0.0, 4.0), step, int(20.0 / step))
        for unit in range(9)
        for direction in (1.0, -1.0, 1.0)
        for step in (0.05 * (1 + unit % 3),)
    ]


def test_a_wave_keeps_its_amplitude_and_phase_whatever_the_sampling():
    found = spectrum_of(samples_of(many_strokes()), "displacement_mm")
    both_ways = found.mean[0]
    k = int(np.argmax(np.abs(both_ways)))
    assert 1 / found.frequency[k] == pytest.approx(LENGTH_MM, rel=0.03)
    # The amplitude is a mean over passes of the units' sums, and a unit has two passes.
    assert np.abs(both_ways[k]) == pytest.approx(A_N, rel=0.1)  # the wave lies between two frequencies
    assert np.angle(both_ways[k]) == pytest.approx(PHASE, abs=0.2)
    assert found.units[0] == 9
    assert found.count[k] == 18


def test_frequencies_that_a_stroke_cannot_show_are_none_of_it():
    fine = [(unit, 1.0, 0.3 * unit, 0.05, 400) for unit in range(6)]
    coarse = [(unit, 1.0, 0.3 * unit, 0.5, 40) for unit in range(6, 10)]
    found = spectrum_of(samples_of(fine + coarse), "displacement_mm")
    npt.assert_array_equal(
        found.count[found.frequency < 0.9], 10
    )  # below half the sampling rate of the coarse ones
    npt.assert_array_equal(found.count[found.frequency > 1.1], 6)


def test_a_unit_whose_strokes_reach_no_frequency_adds_nothing():
    fine = [(unit, 1.0, 0.3 * unit, 0.05, 400) for unit in range(12)]
    coarse = [(unit, 1.0, 0.3 * unit, 18.0, 17) for unit in range(12, 14)]
    short = [(unit, 1.0, 0.3 * unit, 0.05, 400) for unit in range(12, 14)]
    found, without = (spectrum_of(samples_of(fine + more), "displacement_mm") for more in (coarse, short))
    assert found.count.max() == 12
    assert without.count.max() == 14


def test_strokes_too_few_or_too_short_have_no_spectrum():
    two = [(0, 1.0, 0.0, 0.05, 400), (1, 1.0, 0.0, 0.05, 400)]
    assert spectrum_of(samples_of(two), "displacement_mm") is None
    assert spectrum_of(samples_of([(k, 1.0, 0.0, 0.5, 15) for k in range(5)]), "displacement_mm") is None
    assert spectrum_of(samples_of([(0, 1.0, 0.0, 0.5, 15)]).head(0), "displacement_mm") is None


def test_what_is_in_the_model_already_is_taken():
    found = spectrum_of(samples_of(many_strokes()), "displacement_mm", [5.1])
    step = found.frequency[1] - found.frequency[0]
    npt.assert_array_equal(found.taken, np.abs(found.frequency - 1 / 5.1) <= 4 * step)
