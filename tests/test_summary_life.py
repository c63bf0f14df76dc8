"""What `lifetime` ends with, for every kind of answer."""

import numpy as np
import pytest

from sealfit.fit.aging.joint_law import Aged, fit_laws, rivals_of
from sealfit.fit.aging.lifetime import Goal, answer, finite_ends, over_laws, unknown_scatter
from sealfit.report.summary_lines import lifetime_lines

DAYS = np.array([0.0, *[1.0, 2.0, 4.0, 8.0, 12.0, 16.0] * 3])
CELSIUS = np.array([23.0, *[40.0] * 6, *[60.0] * 6, *[80.0] * 6])


@pytest.fixture(scope="module")
def laws():
    rate = np.exp(80.0 / 8.314462618e-3 * (1 / 333.15 - 1 / (CELSIUS + 273.15)))
    value = 0.93 - 0.05 * np.log1p(rate * DAYS / 0.1)
    return fit_laws(Aged(DAYS, value * (1 + 0.01 * np.random.default_rng(1).standard_normal(19)), CELSIUS))


def said(laws, goal, years=None, notes=(), **place):
    part = {"quantity": "mu_s", "model": "after", "effects": [], "notes": notes}
    part |= answer(laws[0], goal, years, resample=True, **place)
    part["rivals"] = [answer(rival, goal, years, **place) for rival in rivals_of(laws)]
    if years is None:
        part["ci95_over_laws"] = finite_ends(over_laws(laws, goal, **place))
    return "\n".join(lifetime_lines(part))


def test_days_have_their_intervals_and_the_rivals_answer(laws):
    text = said(laws, Goal(0.75), temperature_C=50.0)
    assert " d to 0.75, 95 % " in text
    assert "by resampling" in text
    assert ("over all laws" in text) == bool(rivals_of(laws))


@pytest.mark.parametrize(
    ("value", "words"),
    [(-1.0, "-1 is not reached within 1e9 d"), (0.99, "unaged rubber is already beyond 0.99")],
)
def test_what_is_never_or_already_reached_is_said(laws, value, words):
    text = said(laws, Goal(value), temperature_C=20.0)
    assert words in text
    assert "None" not in text
    assert "nan" not in text


def test_a_life_without_limits_is_said_to_have_none():
    """Rubber that does not age."""
    days = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0])
    value = 0.7 + 0.01 * np.random.default_rng(3).standard_normal(8)
    text = said(fit_laws(Aged(days, value)), Goal(0.69))
    assert "d to 0.69, without a finite 95 % interval (extrapolated" in text


def test_the_interval_over_all_laws_is_given_if_the_first_law_never_ends():
    days = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0])
    value = 0.7 - 0.05 * np.log1p(days) * (1 + 0.05 * (-1.0) ** np.arange(8))
    laws = sorted(fit_laws(Aged(days, value)), key=lambda law: law.loss.name != "stretched")
    text = said(laws, Goal(0.1))
    assert "0.1 is not reached within 1e9 d" in text
    assert "the interval is over all laws" in text
    assert "95 % interval if this law is true: more than 1e9 d" in text


def test_the_temperature_for_years_has_an_interval_and_is_marked_beyond_the_tests(laws):
    text = said(laws, Goal(loss=0.3), 10.0)
    assert "it lasts 10 years at " in text
    assert " degC, 95 % " in text
    assert "extrapolated" in text


def test_a_remark_on_the_values_stands_above_the_life(laws):
    text = said(laws, Goal(0.75), notes=["the mean coefficient over these speeds."], temperature_C=50.0)
    assert "\nnote        mu_s is the mean coefficient over these speeds.\nlife " in text


def test_a_law_with_as_many_parameters_as_days_has_an_interval_only_if_specimens_are_known_to_scatter(laws):
    days, values = np.array([0.0, 2.0, 8.0]), np.array([0.93, 0.85, 0.8])
    few = fit_laws(Aged(days, values))
    text = said(few, Goal(0.82), notes=unknown_scatter(few[0]))
    assert "mu_s is of unknown uncertainty" in text
    assert "0.82, without a finite 95 % interval" in text
    known = fit_laws(Aged(days, values, specimens=(0.02, 3.0)))
    assert unknown_scatter(known[0]) == []
    life = answer(known[0], Goal(0.82))
    assert 0 < life["ci95"][0] < 0.7 * life["days"]
    assert (known[0].df, known[0].scatter) == (3.0, 0.02)
    assert unknown_scatter(laws[0]) == []
