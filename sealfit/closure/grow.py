"""Round after round: search, name, confirm, add, refit, drop what became needless, until nothing is left."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from sealfit.closure.channels import CALENDAR, Channel, find_channels
from sealfit.closure.confirm import heldout_gain
from sealfit.closure.forms import PERIODIC
from sealfit.closure.judge import Candidate, Judge
from sealfit.closure.naming import HALF, Proposal, propose, rivals
from sealfit.closure.pairs import pairs_in_disguise, search_pairs
from sealfit.closure.ripple import Peak, find_ripple
from sealfit.closure.search import search
from sealfit.config import Config
from sealfit.effects.contract import Effect
from sealfit.fit.estimate import Fitted, fit, fit_declared
from sealfit.fit.joint import Term, evaluate, passes
from sealfit.fit.rows import Rows

TRIES = 3  # proposals put to held-out data in a round before the residual is called unexplained


@dataclass(frozen=True)
class Added:
    """An accepted effect: the proposal, its gain on held-out data and the rivals these data cannot tell from it."""

    proposal: Proposal
    gain_N: float
    rivals: tuple[Proposal, ...]
    round: int


@dataclass(frozen=True)
class Grown:
    """The end of the loop on some rows: both fits, what was added, and what the last searches found."""

    before: Fitted
    after: Fitted
    added: tuple[Added, ...]
    first: tuple[Candidate, ...]  # candidates on the declared model
    last: tuple[Candidate, ...]  # candidates on the final one
    left: Candidate | Peak | None  # what is still significant
    channels: Mapping[str, Channel] = field(default_factory=dict)


def grow(
    rows: Rows,
    samples: pd.DataFrame,
    config: Config,
    effects: Mapping[str, Effect],
    *,
    start: Fitted | None = None,
    on_found: Callable[[Fitted], None] | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> Grown:
    """Return the model grown until no channel orders its residual.

    Parameters
    ----------
    rows : Rows
        Bins as arrays.
    samples : DataFrame
        Steady samples for the ripple search: as `steady_samples` gives them.
    config : Config
        Levels of error, rounds, folds.
    effects : mapping
        The catalogue.
    start : Fitted, optional
        The declared model fitted to more rows: where the fit begins, so that it need not search again.
    on_found : callable, optional
        Given the declared fit as soon as the first search has found something.
    on_progress : callable, optional
        Told in words what is being done.
    """
    say = on_progress or (lambda text: None)
    rng = np.random.default_rng(config.loop.seed)
    unit = config.units.unit("force")
    rig = config.position_origin == "rig"
    before = fitted = fit_declared(rows) if start is None else fit(start.model, rows, start.scatter, turns=1)
    channels = {
        c.name: c
        for c in find_channels(rows, config.loop.ignore_channels, conditions=config.condition, rig_position=rig)
    }
    alpha = config.loop.family_error
    added: list[Added] = []
    refused: set[tuple] = set()
    first: tuple[Candidate, ...] = ()
    last: tuple[Candidate, ...] = ()
    left: Candidate | Peak | None = None
    strongest: Peak | None = None
    periodic: tuple | None = None
    for number in range(1, config.loop.max_rounds + 2):
        judge = Judge(fitted)
        candidates = search(judge, list(channels.values()), rng)
        last = tuple(candidates)
        first = first or last
        if periodic != _periodic_terms(fitted):  # only these change what the spectrum sees
            periodic = _periodic_terms(fitted)
            seen = _residual_samples(samples, fitted)
            strongest = find_ripple(seen, common_phase=rig, known=_wavelengths(fitted))
        peak = strongest
        peak = peak if peak is not None and peak.p_value <= alpha and ("peak", peak.axis) not in refused else None
        significant = [c for c in candidates if c.p_value <= alpha]
        say(f"round {number}: {len(candidates)} candidates on {len(channels)} channels, {len(significant)} significant")
        if not significant and peak is None:
            pairs = search_pairs(judge, list(channels.values()), candidates, rng)
            significant = [c for c in pairs if c.p_value <= alpha]
            say(f"round {number}: {len(pairs)} pairs, {len(significant)} significant")
        left = significant[0] if significant else peak
        significant += pairs_in_disguise(judge, significant, channels)
        open_ = [c for c in significant if c.key not in refused]
        if (not open_ and peak is None) or number > config.loop.max_rounds:
            break
        if number == 1 and on_found is not None:
            on_found(before)
        open_ += [c for c in _standing_for(open_, candidates) if c.key not in refused]
        proposals = propose(fitted, open_, channels, peak, seen, effects)
        accepted = None
        for proposal in proposals[:TRIES]:
            gain = heldout_gain(fitted, proposal, config.loop.folds, config.loop.seed, seen)
            say(f"  {describe(proposal.term)}: held-out gain {gain.rmse_N:.4g} {unit}")
            if gain.real:
                accepted = Added(proposal, gain.rmse_N, tuple(rivals(proposal, proposals)), number)
                break
        if accepted is None:
            tried = {p.source for p in proposals[:TRIES]}
            refused |= tried or {c.key for c in open_}
            continue
        added.append(accepted)
        fitted = fit(accepted.proposal.fitted.model, rows, fitted.scatter, turns=2)
        fitted, kept = _drop_needless(fitted, added)
        refused |= {
            a.proposal.source for a in added if all(a is not k for k in kept)
        }  # what came and went does not come again
        added = kept
    return Grown(before, fitted if added else before, tuple(added), first, last, left, channels)


def _standing_for(significant: list[Candidate], candidates: list[Candidate]) -> list[Candidate]:
    """Return candidates of a condition that explain at least half of what the calendar does on the same quantity.

    Conditions are tested one after the other, so the calendar follows them, and a dozen specimens alone may not say so.
    """
    found = []
    keys = {c.key for c in significant}
    for calendar in (c for c in significant if c.channels[0] in CALENDAR):
        for c in candidates:
            alike = c.unit == "specimen" and (c.acts_on, c.operation) == (calendar.acts_on, calendar.operation)
            if alike and c.key not in keys and c.chi2 >= HALF * calendar.chi2:
                found.append(replace(c, p_value=calendar.p_value))
                keys.add(c.key)
    return found


def describe(term: Term) -> str:
    """Return an effect in words, e.g. "ripple along displacement_mm, on force"."""
    label = term.effect.label.replace("{x}", term.channels[0]).replace("{z}", term.channels[-1])
    return f"{label}, {'added to' if term.operation == 'add' else 'factor on'} {term.acts_on}"


def _drop_needless(fitted: Fitted, added: list[Added]) -> tuple[Fitted, list[Added]]:
    """Return the fit without effects that a later one has made needless, by Schwarz's price.

    A ripple whose phase is each file's own was judged on the raw samples, which bins cannot overrule.
    """
    k = 0
    while k < len(added) - 1:
        price = added[k].proposal.price
        own_phases = "shift" in added[k].proposal.term.fixed
        if own_phases or _wald(fitted, k) > 2 * price:  # far from needless: no refit is wanted to see that
            k += 1
            continue
        without = fit(fitted.model.without_term(k), fitted.rows, fitted.scatter, turns=0, friction=fitted.friction)
        if without.deviance - fitted.deviance < price:
            fitted = fit(without.model, fitted.rows, fitted.scatter, turns=1)
            added = [a for j, a in enumerate(added) if j != k]
        else:
            k += 1
    return fitted, added


def _wald(fitted: Fitted, number: int) -> float:
    """Return the squared standardised size of an effect's amplitudes, all together."""
    at = fitted.model.place(number).start
    effect, values = fitted.model.terms[number].effect, fitted.model.values[number]
    places = [at + k for k, p in enumerate(effect.parameters) if p.linear]
    amplitude = np.array([values[p.name] for p in effect.parameters if p.linear])
    return float(amplitude @ np.linalg.pinv(fitted.covariance[np.ix_(places, places)]) @ amplitude)


def numbered(bins: pd.DataFrame) -> pd.DataFrame:
    """Return `bins` with `stroke_id`, a number per stroke that samples and every part of the rows share."""
    return bins.assign(stroke_id=bins.groupby(["file", "stroke"], sort=False).ngroup().to_numpy())


def steady_samples(traces: pd.DataFrame, rows: Rows) -> pd.DataFrame:
    """Return the steady samples of the strokes in `rows`, for the ripple search.

    Parameters
    ----------
    traces : DataFrame
        Table `traces`, the samples of a stroke one after the other.
    rows : Rows
        Rows made from `numbered` bins.

    Returns
    -------
    DataFrame
        stroke_id, stroke, direction, unit (number of the file), displacement_mm, time_s, force_N.
    """
    first = rows.groups.starts["stroke"]
    strokes = rows.table.iloc[first]
    steady = traces[traces["steady"].to_numpy(dtype=bool)]
    file, stroke = steady["file"].to_numpy(), steady["stroke"].to_numpy()
    change = np.flatnonzero(np.r_[True, (file[1:] != file[:-1]) | (stroke[1:] != stroke[:-1])])
    own = pd.MultiIndex.from_frame(strokes[["file", "stroke"]]).get_indexer(
        pd.MultiIndex.from_arrays([file[change], stroke[change]])
    )
    place = np.repeat(own, np.diff(np.r_[change, file.size]))
    known = place >= 0
    place = place[known]
    table = {name: steady[name].to_numpy()[known] for name in ("displacement_mm", "time_s", "force_N")}
    return pd.DataFrame(
        {
            "stroke_id": strokes["stroke_id"].to_numpy()[place],
            "stroke": strokes["stroke"].to_numpy()[place],
            "direction": strokes["direction"].to_numpy()[place],
            "unit": rows.codes("file")[first][place],
            **table,
        }
    )


def _periodic_terms(fitted: Fitted) -> tuple:
    """Return the periodic effects of a model with their values."""
    pairs = zip(fitted.model.terms, fitted.model.values, strict=True)
    return tuple((t.key(), *v.values()) for t, v in pairs if t.effect.id in PERIODIC)


def _wavelengths(fitted: Fitted) -> list[tuple[str, float]]:
    """Return (axis, wavelength) of the periodic effects of a model."""
    pairs = zip(fitted.model.terms, fitted.model.values, strict=True)
    return [(t.channels[0], v["lambda_"]) for t, v in pairs if t.effect.id in PERIODIC]


def _residual_samples(samples: pd.DataFrame, fitted: Fitted) -> pd.DataFrame:
    """Return the samples with `residual_N`: force less the periodic effects already in the model.

    Everything slow is taken out of each stroke by the spectrum itself; what is periodic is evaluated at the samples.
    """
    residual = samples["force_N"].to_numpy(dtype=float)
    terms = [(t, v) for t, v in zip(fitted.model.terms, fitted.model.values, strict=True) if t.effect.id in PERIODIC]
    if terms:
        rows = fitted.rows
        strokes = rows.table.iloc[rows.groups.starts["stroke"]]
        ids, own = strokes["stroke_id"].to_numpy(), samples["stroke_id"].to_numpy()
        level = np.zeros(max(ids.max(), own.max()) + 1)
        level[ids] = rows.groups.means(fitted.force, "stroke")
        for term, values in terms:
            place = samples[term.channels[0]].to_numpy(dtype=float)
            shift = term.fixed.get("shift")
            if shift is not None:
                shifts = np.zeros_like(level)
                shifts[ids] = passes(strokes).map(shift).to_numpy(dtype=float)
                place = place + shifts[own]
            shape = term.effect.shape({term.effect.reads[0]: place, **term.fixed}, **values)
            residual = residual - shape * (1.0 if term.operation == "add" else level[own])
    return samples.assign(residual_N=residual)


def predict_rows(fitted: Fitted, rows: Rows) -> np.ndarray:
    """Return the fitted model's force at other rows of the same campaign, shape (n,)."""
    return evaluate(fitted.model, rows, jacobian=False)[0]
