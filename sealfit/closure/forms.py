"""The forms fitted for a candidate, richer aging laws among them, and the grids of their parameters."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.special import fdtrc

from sealfit.closure import criteria
from sealfit.closure.channels import FINER, Channel, scaled
from sealfit.closure.errors_and_intervals import t_quantile
from sealfit.closure.linearised import Proposal, middles
from sealfit.closure.ripples import Peak, common_wavelength, pass_shifts
from sealfit.closure.score_test import Candidate, ScoreTestResult, project
from sealfit.closure.small_sample_test import SmallSampleTest
from sealfit.effects.contract import CHANNEL, READS_ANY, SECOND, Effect
from sealfit.effects.free import LEVELS, SLOPES, SMOOTH, SURFACE, WIDE, WITHIN, free_effect, natural
from sealfit.fit.joint import Fitted, fit, reestimated
from sealfit.fit.joint.model import Term, mean_derivatives, shape_of
from sealfit.fit.joint.rows import Rows
from sealfit.fit.steady import FORCES
from sealfit.tables import HISTORY

ADDED, MU = ("force", "add"), ("mu", "multiply")
MOST_PLACES = 60  # Largest number of places of a jump on a grid, or of pairs of two jumps.
# Number of mu_s, mu_c, v_s and sigma_2 that the speeds of a series determine, by the form of its curve.
NUMBERS_ALONG_SPEED = {"full": 4, "interpolated": 3, "viscous": 2, "constant": 1}
PHASE_GRID = tuple(np.arange(4) * np.pi / 4)  # Phases of a ripple that are tried, in rad.
# Distance from 0, in ranges of the positions, beyond which the phase of a wave is given near the positions.
# Phase and wavelength have a correlation of 1 - 4e-6 there; at 25,000 ranges the fit cannot tell them apart.
FAR = 100.0
# Channels along which the amplitude of a wave may change.
CHANGES_A_WAVE = (
    "direction", "speed_mm_s", "load_N", "temperature_C", "compression_ratio_pct", "aging_days"
)  # fmt: skip


def terms_of(
    candidate: Candidate, channels: Mapping[str, Channel], fitted: Fitted, effects: Mapping[str, Effect]
) -> Iterator[tuple[Term, dict]]:
    """Yield every form that fits a candidate, with a grid for each nonlinear parameter."""
    target = candidate.target
    if candidate.pair:
        pair = [channels[name] for name in candidate.channels]
        yield from _terms_of_pair(*pair, target, effects, alone=main_effects_identifiable(pair, fitted))
        return
    name = candidate.channels[-1]
    channel = channels[name]
    knots = min(criteria.MOST_KNOTS, candidate.test_result.units // criteria.UNITS_PER_KNOT)
    if candidate.category is None:
        forms = _terms_of_single(channel, target, channels, fitted, effects, knots)
    else:
        forms = [(within_term(free_term(channel, *target, knots=knots), candidate), {})]
    for term, grid in forms:
        fits = len(term.effect.parameters) <= room_along(channel, fitted, term.target)
        # a smoothing spline has fewer effective degrees of freedom
        if fits or len(term.channels) > 1 or term.smoothness is not None:
            yield term, grid


def main_effects_identifiable(channels: Sequence[Channel], fitted: Fitted) -> bool:
    """Whether the rows distinguish shapes of some channels from specimens' scatter and the declared model."""
    known = fitted.knows_specimens or all(c.unit != "specimen" for c in channels)
    return known and all(room_along(c, fitted) > 0 for c in channels)


def room_along(channel: Channel, fitted: Fitted, target: tuple[str, str] = MU) -> int:
    """Return how many parameters of an effect a channel's settings determine beside the declared model's.

    Eq. 14 has up to four parameters along speed, one less where sigma_2 is at its limit, and Eq. 15 three
    along days. Along other channels there is a constant, and along days for v_s, sigma_2 or an added force.
    """
    declared = fitted.model.declared
    own = 1
    if channel.name == "speed_mm_s":
        held = {p.owner for p, at in zip(declared.parameters, fitted.at_limit, strict=False) if at}
        own = max(NUMBERS_ALONG_SPEED[form] - (owner in held) for owner, form in declared.stribeck.items())
    elif channel.name == AGING and any(declared.law.values()):
        own = 1 if target == ADDED or target[0] in ("v_s", "sigma_2") else 3
    return np.unique(channel.values).size - own


def _terms_of_single(
    channel: Channel,
    target: tuple[str, str],
    channels: Mapping[str, Channel],
    fitted: Fitted,
    effects: Mapping[str, Effect],
    knots: int,
) -> Iterator[tuple[Term, dict]]:
    """Yield every form of one channel on a quantity, with a grid for each nonlinear parameter."""
    name = channel.name
    for effect in effects.values():
        if effect.periodic:
            continue
        viscous = name == "speed_mm_s" and effect.reads == (name,) and effect.acts_on == (ADDED,)
        own = ADDED if viscous else target  # the search tests speed on mu and sigma_2 only
        if own not in effect.acts_on or not _all_read(effect, channels, fitted.rows, effects):
            continue
        if effect.reads in READS_ANY and SECOND not in effect.reads:
            if not _may_follow(effect, channel, fitted):
                continue
            fixed = {"x_ref": reference(channel.values)}
            held = _within_reach(effect, channel.values)
            yield Term(held, (name, *effect.reads[1:]), *target, fixed=fixed), grid_of(held, channel.values)
        elif name in effect.reads:
            fixed = {f"{c}_ref": reference(fitted.rows.unsigned(c)) for c in effect.reads}
            grids = grid_of(effect, channel.values)
            yield Term(effect, effect.reads, *own, fixed=fixed), grids
            # the search tests the factor only
            if target == MU and ("mu", "add") in effect.acts_on:
                yield Term(effect, effect.reads, "mu", "add", fixed=fixed), grids
    if name != "direction":
        yield free_term(channel, *target, knots=knots), {}


def _may_follow(effect: Effect, channel: Channel, fitted: Fitted) -> bool:
    """Whether a form for any channel is fitted to this one."""
    if not channel.numeric or channel.name == "direction":
        return False
    distinct = np.unique(channel.values)
    sample = distinct[:: max(1, distinct.size // 50)]
    with np.errstate(all="ignore"):
        inputs = {CHANNEL: sample, "direction": 1.0, "x_ref": reference(channel.values)}
        if not np.isfinite(effect.shape(inputs, **effect.start())).all():
            return False
    if effect.id == "offset_slope":  # not along strokes, and not if the offset is in the model
        has_offset = any(term.effect.id == "zero_offset" for term in fitted.model.terms)
        return FINER[channel.unit] > FINER["stroke"] and not has_offset
    return channel.name not in HISTORY or effect.along_calendar


def _all_read(
    effect: Effect, channels: Mapping[str, Channel], rows: Rows, effects: Mapping[str, Effect]
) -> bool:
    """Whether the campaign has the channels that an effect reads, and its values can show it.

    Some may be constant (the one load of a campaign), unless the effect is then the same as another one.
    """
    varying = {name for name in effect.reads if name in channels or name == CHANNEL}
    still = set(effect.reads) - varying
    if not still:
        return not effect.shown_by or effect.shown_by(rows.values(effect.reads[0]))
    constant = all(name in rows.channels and rows.values(name).dtype.kind == "f" for name in still)
    return bool(varying) and constant and not any(set(other.reads) == varying for other in effects.values())


def _terms_of_pair(
    one: Channel, other: Channel, target: tuple[str, str], effects: Mapping[str, Effect], *, alone: bool
) -> Iterator[tuple[Term, dict]]:
    """Yield the forms of a pair of channels: products, or a slope for each category.

    Forms with main effects need `alone`: they may explain the specimens' scatter, or the Stribeck curve.
    """
    if not (one.numeric and other.numeric):
        number, category = (one, other) if one.numeric else (other, one)
        fixed = {"categories": tuple(np.unique(category.values)), "x_ref": reference(number.values)}
        yield Term(free_effect(SLOPES, fixed), (number.name, category.name), *target, fixed=fixed), {}
        return
    for x, z in ((one, other), (other, one)):
        for effect in effects.values():
            if effect.reads != (CHANNEL, SECOND) or target not in effect.acts_on or effect.periodic:
                continue
            if len(effect.linear) > 1 and not alone:
                continue
            fixed = {"x_ref": reference(x.values), "z_ref": reference(z.values)}
            inputs = {CHANNEL: x.values, SECOND: z.values, **fixed}
            with np.errstate(all="ignore"):
                good = np.isfinite(effect.shape(inputs, **effect.start())).all()
            if good and (effect.id not in ("product", "bilinear") or x is one):  # symmetric in the two
                yield Term(effect, (x.name, z.name), *target, fixed=fixed), {}
    for effect in effects.values():
        if set(effect.reads) == {one.name, other.name} and target in effect.acts_on:
            fixed = {f"{c.name}_ref": reference(c.values) for c in (one, other)}
            yield Term(effect, effect.reads, *target, fixed=fixed), grid_of(effect, one.values)


def free_term(channel: Channel, acts_on: str, operation: str, *, knots: int = criteria.FREE_DF + 1) -> Term:
    """Return the free shape of a channel: a level per category, or a spline, penalised if of many knots."""
    if channel.numeric:
        places = _knots(np.unique(channel.values), max(knots, criteria.FREE_DF + 1))
        means = natural(places, channel.values).mean(axis=0)
        fixed = {"knots": places, "x_ref": places[0], "means": tuple(means.tolist())}
        smoothness = 1.0 if len(places) > criteria.FREE_DF + 1 else None
        return Term(free_effect(SMOOTH, fixed), (channel.name,), acts_on, operation, fixed, smoothness)
    categories, count = np.unique(channel.values, return_counts=True)
    fixed = {"categories": tuple(categories.tolist()), "means": tuple((count / count.sum()).tolist())}
    return Term(free_effect(LEVELS, fixed), (channel.name,), acts_on, operation, fixed)


def within_term(term: Term, candidate: Candidate) -> Term:
    """Return a free shape of a number in the one category of a candidate, with a penalty."""
    fixed = {"category": candidate.category, "knots": term.fixed["knots"]}
    names = (*term.channels, candidate.channels[0])
    return Term(free_effect(WITHIN, fixed), names, *term.target, fixed=fixed, smoothness=1.0)


def surface_term(one: Channel, other: Channel, acts_on: str, operation: str) -> Term:
    """Return the free surface of two numeric channels, with a penalty."""
    x, z = (_knots(np.unique(c.values), criteria.SURFACE_KNOTS) for c in (one, other))
    means = np.einsum("nj,nk->jk", natural(x, one.values), natural(z, other.values)) / one.values.size
    fixed = {"x_knots": x, "z_knots": z, "means": tuple(means.ravel().tolist())}
    names = (one.name, other.name)
    return Term(free_effect(SURFACE, fixed), names, acts_on, operation, fixed, smoothness=1.0)


def _knots(values: np.ndarray, count: int) -> tuple[float, ...]:
    """Return up to `count` knots for sorted values of a channel, or the distinct values if there are no more.

    Even knots in a gap between the values are left out: nothing determines them.
    """
    at, kept = scaled(values), [0]
    while (after := int(at.searchsorted(at[kept[-1]] + criteria.KNOTS_APART, "right"))) < at.size:
        kept.append(after)
    wide = values[0] > 0 and values[-1] / values[0] >= WIDE
    if len(kept) <= count:
        return tuple(values[kept].tolist())
    if not wide and count <= criteria.FREE_DF + 1:
        return tuple(np.quantile(values[kept], np.linspace(0, 1, count)).tolist())
    knots = (np.geomspace if wide else np.linspace)(values[0], values[-1], count)
    middles = np.sqrt(knots[1:] * knots[:-1]) if wide else (knots[1:] + knots[:-1]) / 2
    return tuple(knots[np.bincount(middles.searchsorted(values), minlength=count) > 0].tolist())


def periodic_terms(
    fitted: Fitted,
    peak: Peak,
    samples: pd.DataFrame,
    effects: Mapping[str, Effect],
    channels: Collection[str],
) -> Iterator[tuple[Term, dict, Candidate]]:
    """Yield the terms that a periodic component may be, each with its grid and a candidate.

    Its amplitude may change with those of the `channels` in `CHANGES_A_WAVE`.
    """
    rows = fitted.rows
    effect = _near(effects["ripple"] if peak.axis == "displacement_mm" else effects["sinusoid"], peak)
    changing = _near(effects["sinusoid_changing"], peak)
    both = np.unique(np.sign(rows.speed)).size == 2
    targets = [ADDED] if peak.sign_symmetric else []
    if not both or not peak.sign_symmetric:
        targets += [("mu", "multiply"), ("force", "multiply")]
    places = rows.values(peak.axis)
    far = peak.common_phase and np.abs(places).min() > FAR * np.ptp(places)
    fixed: dict = {"x_ref": reference(places) if far else 0.0}
    phases, lengths = PHASE_GRID, (peak.wavelength,)
    if not peak.common_phase:
        length, error = common_wavelength(samples, peak.wavelength, peak.axis)
        reach = t_quantile(max(rows.groups.starts["file"].size - 1, 2)) * error
        fixed["shift"] = pass_shifts(samples, rows, length, peak.axis)
        fixed["held"] = {"lambda_": (length - reach, length + reach), "phi": (-np.pi, np.pi)}
        lengths, phases = (length,), (0.0,)
    names = {p.name: lengths if p.name == "lambda_" else phases for p in effect.nonlinear}
    units = rows.groups.starts["file"].size
    test_result, no_columns = ScoreTestResult(0.0, 2, units, 0.0), np.empty((0, 0))
    for target in targets:
        if target not in effect.acts_on:
            continue
        candidate = Candidate((peak.axis,), *target, "file", no_columns, test_result, peak.p_value)
        yield Term(effect, (peak.axis,), *target, fixed=fixed), names, candidate
        for name in CHANGES_A_WAVE:
            if name in channels:
                own = {**fixed, "z_ref": 0.0 if name == "direction" else reference(rows.unsigned(name))}
                yield Term(changing, (peak.axis, name), *target, fixed=own), names, candidate


def _near(effect: Effect, peak: Peak) -> Effect:
    """Return a periodic effect with the wavelength bounded to a fifth about that of a peak."""
    near = {"bounds": (0.8 * peak.wavelength, 1.25 * peak.wavelength), "start": peak.wavelength}
    parameters = (replace(p, **near) if p.name == "lambda_" else p for p in effect.parameters)
    return replace(effect, parameters=tuple(parameters))


def reference(values: np.ndarray) -> float:
    """Return a channel's reference value: its mean, rounded to three digits."""
    return float(f"{float(np.mean(values)):.3g}")


def _within_reach(effect: Effect, values: np.ndarray) -> Effect:
    """Return a form with places inside the channel's range and widths of at most a few of its ranges."""
    low, high, span = float(values.min()), float(values.max()), float(np.ptp(values)) or 1.0
    limits = {"inside": (low, high), "between": (low, high), "span": (span / 1000, criteria.SPANS * span)}
    parameters = []
    for p in effect.parameters:
        if p.search in limits:
            near = tuple(float(x) for x in np.clip(limits[p.search], *p.bounds))
            p = replace(p, bounds=near, start=float(np.clip(p.start, *near)))
        parameters.append(p)
    return replace(effect, parameters=tuple(parameters))


def grid_of(effect: Effect, values: np.ndarray) -> dict[str, tuple[float, ...]]:
    """Return the grid of each nonlinear parameter, from the values of the channel, shape (n,)."""
    span = float(np.ptp(values)) or 1.0
    grids = {}
    for p in effect.nonlinear:
        if p.search == "inside":
            grid = np.quantile(np.unique(values), np.linspace(0.05, 0.95, 13))
        elif p.search == "between":
            middle, jumps = middles(values), sum(other.search == "between" for other in effect.nonlinear)
            most = round(MOST_PLACES ** (1 / jumps))
            grid = middle[np.unique(np.linspace(0, middle.size - 1, most).astype(int))]
        elif p.search == "span":
            grid = np.geomspace(span / 100, span * 2, 13)
        elif p.search == "ratio":
            positive = np.abs(values[values != 0])
            grid = np.geomspace(positive.min(), positive.max(), 13) if positive.size else np.array([p.start])
        else:
            grid = np.array(p.search or (p.start,))
        grids[p.name] = tuple(float(x) for x in np.unique(np.clip(grid, *p.bounds)))
    return grids


def describe(term: Term, rows: Rows) -> str:
    """Return the label of an effect, e.g. "ripple along displacement_mm, added to force"."""
    label = term.effect.label.replace("{x}", term.channels[0]).replace("{z}", term.channels[-1])
    fitted_instead = {} if rows.has_load else {"mu": "friction", **FORCES}
    target = fitted_instead.get(term.acts_on, term.acts_on)
    return f"{label}, {'added to' if term.operation == 'add' else 'factor on'} {target}"


# ---------------------------------------------------------------- richer laws
# The declared law is flexible: with a and b free it explains most of the effect of a floor or an induction
# time, and a dozen specimens give little evidence of the rest. Each richer law of the catalogue is therefore
# fitted jointly from several starts, with its own estimate of the specimens' scatter. With n specimens, p
# parameters of the declared law and q more, the restricted deviances D give the ratio of the residual
# variances between specimens,
#
# .. math::
#     \log \frac{S_0}{S_1} = \frac{1}{n} \Big(D_0 - D_1 + n \log \frac{n - p}{n - p - q} - q \Big), \qquad
#     F = \Big(\frac{S_0}{S_1} - 1\Big) \frac{n - p - q}{q}
#
# or, if that is smaller, F = t^2 / q of its amplitude: near a bound either alone may be too large.

AGING = "aging_days"
FEWEST = 2  # Additional parameters of a richer law: an amplitude and a day.
ROWS = 2  # Rows per stroke: aging changes strokes as a whole.
STARTS = 4  # Start values of a law's nonlinear parameter, in days.


def richer_laws(
    fitted: Fitted, channels: Mapping[str, Channel], effects: Mapping[str, Effect]
) -> list[tuple[Candidate, Proposal]]:
    """Return each richer aging law with its adjusted test; none with 30 specimens or more."""
    specimens = fitted.rows.groups.starts["specimen"].size
    by_specimen = AGING in channels and channels[AGING].unit == "specimen"
    lawful = by_specimen and any(fitted.model.declared.law.values())
    spare = specimens - fitted.model.declared.mu_parameter_count
    before_last = np.unique(fitted.rows.days[fitted.rows.days > 0])[:-1]  # days at which the search starts
    if not lawful or specimens >= criteria.JACKKNIFE_UNITS or spare <= FEWEST or not before_last.size:
        return []
    known = {t.effect.id for t in fitted.model.terms}
    laws = [e for e in effects.values() if e.physical and e.reads == (AGING,) and MU in e.acts_on]
    laws = [e for e in laws if e.id not in known and len(e.linear) == 1 and e.nonlinear]
    rows = fitted.rows.sparse(ROWS)
    before = reestimated(fit(fitted.model, rows, fitted.scatter, turns=1))
    found = [_law_test(fitted, before, effect, len(laws)) for effect in laws]
    return [f for f in found if f is not None]


def _law_test(fitted: Fitted, before: Fitted, effect: Effect, laws: int) -> tuple[Candidate, Proposal] | None:
    term = Term(effect, effect.reads, *MU, fixed={})
    after = _best(before, term)
    place = len(after.model.terms) - 1
    without = reestimated(before.refitted(after.model.without_term(place)))
    gain = min(before.deviance, without.deviance) - after.deviance
    units = fitted.rows.groups.starts["specimen"].size
    q, left = len(effect.parameters), units - fitted.model.declared.mu_parameter_count
    error = left - q
    if error < 1:
        return None
    amplitude = effect.linear[0]
    at = after.model.term_slice(place).start + [p.name for p in effect.parameters].index(amplitude)
    ratio = np.exp((gain + units * np.log(left / error) - q) / units)
    t = after.model.values[place][amplitude] / np.sqrt(max(after.covariance[at, at], 1e-300))
    f = max(min((ratio - 1) * error / q, t**2 / q), 0.0)
    p_value = fdtrc(q, error, f)
    values = after.model.values[place]
    shape = shape_of(term, values, fitted.rows)
    column = project(fitted, (fitted.slope(*MU) * shape)[:, None])[:, 0]
    adjusted = float(min(1.0, (criteria.SEARCHES + 1) * laws * p_value))
    test = SmallSampleTest(MU, np.empty((0, q)), 0.0, gain, float(np.log(max(p_value, 1e-300))), 1.0, error)
    test_result = ScoreTestResult(gain, q, units, test.log_p, small_sample=test)
    candidate = Candidate((AGING,), *MU, "specimen", shape[:, None], test_result, adjusted)
    return candidate, Proposal(term, values, "specimen", units, gain, adjusted, column, candidate.key)


def _best(before: Fitted, term: Term) -> Fitted:
    """Return the best joint fit of the law from several start values."""
    effect, rows = term.effect, before.rows
    days = np.unique(rows.days[rows.days > 0])[:-1]
    amplitude, number = effect.linear[0], effect.nonlinear[0].name
    found: list[Fitted] = []
    for day in days[np.unique(np.linspace(0, days.size - 1, STARTS).round().astype(int))].tolist():
        (shape,) = mean_derivatives(term, {**effect.start(), number: day}, rows, only_linear=True)
        left = project(before, (before.slope(*MU) * shape)[:, None])[:, 0]
        size = float(left @ left)
        height = float(left @ before.white_residual) / size if size > 0 else 0.0
        start = {**effect.start(), amplitude: height, number: day}
        model = before.model.with_term(term, {p.name: start[p.name] for p in effect.parameters})
        found.append(before.refitted(model))
    return reestimated(min(found, key=lambda f: f.deviance))
