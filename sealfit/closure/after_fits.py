"""Everything that the fits say, once more with the after-model's effects taken out at their reference."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from sealfit.closure.after_law import after_laws
from sealfit.closure.reference import without_effects
from sealfit.config import Config
from sealfit.fit.all_series import joint_laws
from sealfit.fit.dynamic import fit_dynamic
from sealfit.fit.estimate import Fitted
from sealfit.fit.steady import fit_conditions
from sealfit.profiling import timed
from sealfit.samples import StoredTraces
from sealfit.tables import AFTER, SCHEMAS


def after_fits(
    after: Fitted,
    steady: pd.DataFrame,
    traces: pd.DataFrame | Sequence[StoredTraces],
    config: Config,
    *,
    workers: int = 1,
) -> dict[str, pd.DataFrame]:
    """Return the tables `*_after` by name, without rows where no effect was added: the fits before are the answer then.

    Parameters
    ----------
    after : Fitted
        The after-model, fitted to all bins.
    steady : DataFrame
        Table `steady`.
    traces : DataFrame or sequence of StoredTraces
        Table `traces`, or where it lies.
    config : Config
        The rig.
    workers : int
        Processes.

    Notes
    -----
    The laws of single series are those of the joint fit. Single conditions, from which the laws for all series, the
    starts and the break-away follow, are fitted to the strokes' forces without the effects; the effects' covariance is
    carried through these fits.
    """
    if not after.model.terms:
        return {schema.name: pd.DataFrame(columns=schema.names()) for schema in AFTER}
    free = without_effects(steady, after, config)
    with timed("after: conditions", rows=len(free), of="strokes"):
        conditions = fit_conditions(free, config, workers=workers)
    with timed("after: laws"):
        law, curves = after_laws(after, conditions, config)
        laws, master = joint_laws(free, conditions, config, workers=workers)
    with timed("after: starts", rows=len(free), of="strokes"):
        dynamic = fit_dynamic(traces, free, conditions, config, workers=workers)
    found = {
        "steady_after": free,
        "steady_fit_after": conditions,
        "aging_fit_after": law,
        "aging_curves_after": curves,
        "aging_laws_after": laws,
        "master_curve_after": master,
        "dynamic_fit_after": dynamic.fit,
        "dynamic_curves_after": dynamic.curves,
    }
    return {name: t.assign(model="after") if "model" in SCHEMAS[name].names() else t for name, t in found.items()}
