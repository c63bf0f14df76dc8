"""What closure.json says beyond its verdict."""

from __future__ import annotations

from collections.abc import Mapping

WORSE = 1.01  # times the error before: less is no difference


def predicts_worse(closure: Mapping) -> bool:
    """Return whether effects were added and what was held out is predicted worse with them than without.

    Then the loop has not closed, however little structure is left: somewhere an effect says anything, as a free shape
    does where one stroke alone goes.
    """
    before, after = (closure[name].get("heldout_rmse_N") for name in ("before", "after"))
    added = any(not effect["candidate"] for effect in closure["effects"])
    return bool(added and before is not None and after is not None and after > WORSE * before)
