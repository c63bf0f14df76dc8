"""What all strokes of a large campaign show, though those that were searched do not."""

from __future__ import annotations

import numpy as np

from sealfit.closure.channels import channels_of
from sealfit.closure.grow import Grown
from sealfit.closure.judge import Judge
from sealfit.closure.search import search
from sealfit.config import Config
from sealfit.fit.estimate import Fitted


def overlooked(fitted: Fitted, grown: Grown, config: Config) -> str:
    """Return the channel that still orders the residual of all strokes, though those searched do not show it; or "".

    What they show and what could not be explained there is known already.

    Parameters
    ----------
    fitted : Fitted
        The final model, fitted to all strokes.
    grown : Grown
        What the search of a part came to.
    config : Config
        Levels of error, channels.
    """
    alpha = config.loop.family_error
    found = search(Judge(fitted), channels_of(fitted.rows, config), np.random.default_rng(config.loop.seed))
    known = {c.channels for c in grown.last if c.p_value <= alpha}
    new = (c for c in found if c.p_value <= alpha and c.sure and c.channels not in known)
    return ", ".join(next((c.channels for c in new), ()))
