"""From a friction rig's files to the LuGre model of an aging rubber seal, and to what that model lacks.

`sealfit.run` does what the command of the same name does and returns a `Results`, `sealfit.fit_properties`
does what `fit-aging --values` does, and `sealfit.open` returns those that are there. All are loaded when they
are first asked for, so that the command line starts at once.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sealfit.notebook import Lifetime, Results, fit_properties, run
    from sealfit.notebook import open as open

__version__ = "0.1.0"
# Without `open`: `from sealfit import *` is not to hide Python's own.
__all__ = ["Lifetime", "Results", "fit_properties", "run"]

_LOADED = (*__all__, "open")


def __getattr__(name: str) -> object:
    if name in _LOADED:
        from sealfit import notebook

        return getattr(notebook, name)
    raise AttributeError(f"module 'sealfit' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *_LOADED])
