"""Effects of users: Python files in a folder that the command line names (see `store.paths`).

This is the only place where Python of a user is run. A file has one or more functions that `effect` describes
at its top level, like the modules of this package. Files whose name starts with an underscore are not read.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from itertools import chain
from pathlib import Path
from traceback import walk_tb
from types import ModuleType

import numpy as np

from sealfit.effects import EFFECTS
from sealfit.effects.contract import CHANNEL, READS_ANY, SECOND, Effect, Parameter, effects_in
from sealfit.effects.free import FREE
from sealfit.errors import ConfigError, ParameterError

EXAMPLE = "See sealfit/effects/sensors.py for an example."
TOLERANCE = 1e-9  # relative, of a worked value, which a user may have written with ten digits


def load_user_effects(folder: Path | str | None) -> dict[str, Effect]:
    """Return the effects of every .py file in `folder`, by id, in the order of the file names; none for None.

    ConfigError if the folder is missing, a file cannot be run or defines no effect, an id exists already or
    is no identifier, or an effect violates the contract (worked value, linearity, shape).
    """
    if folder is None:
        return {}
    folder = Path(folder)
    if not folder.is_dir():
        fix = "Check loop.effects_folder in the config."
        raise ConfigError("there is no such folder.", file=folder, fix=fix)
    found: dict[str, Effect] = {}
    for path in sorted(folder.glob("*.py")):
        if path.name.startswith("_"):
            continue
        for effect in _effects_of(path):
            _refuse_taken(effect.id, found, path)
            if fault := contract_fault(effect):
                reason = f"effect '{effect.id}': {fault}."
                raise ConfigError(reason, file=path, fix=f"Fix the file. {EXAMPLE}")
            found[effect.id] = replace(effect, shape=FileShape(path.resolve(), effect.id, effect.shape))
    return found


@dataclass(frozen=True)
class FileShape:
    """The shape of an effect in a user's file; worker processes cannot import it and read the file again."""

    path: Path
    id: str
    function: Callable[..., np.ndarray]

    def __call__(self, inputs: Mapping, **values: float) -> np.ndarray:
        """Return the shape, shape (n,)."""
        return self.function(inputs, **values)

    def __reduce__(self):
        return _read_again, (self.path, self.id)


@lru_cache(maxsize=64)
def _read_again(path: Path, id: str) -> FileShape:
    function = next(effect.shape for effect in _effects_of(path) if effect.id == id)
    return FileShape(path, id, function)


def _effects_of(path: Path) -> list[Effect]:
    # not what it imported
    unique = {id(one): one for one in effects_in(_run(path)) if EFFECTS.get(one.id) is not one}
    if not unique:
        fix = f"Define one at its top level, or move the file. {EXAMPLE}"
        raise ConfigError("holds no effect.", file=path, fix=fix)
    return list(unique.values())


def _run(path: Path) -> ModuleType:
    # The name contains a hash of the path: two folders may have files of one name.
    name = f"sealfit_user_{sha256(str(path.resolve()).encode()).hexdigest()[:12]}_{path.stem}"
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module
    try:
        # The import system would write compiled files to the user's folder, and might use old ones.
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)
    except ParameterError as error:  # raised by the contract
        del sys.modules[name]
        raise ConfigError(str(error), file=path, fix=f"Fix the file. {EXAMPLE}") from error
    except (Exception, SystemExit) as error:  # any error of the user's code
        del sys.modules[name]
        message = f"cannot be run: {type(error).__name__}: {error}."
        fix = "Fix the file, or move it out of the folder."
        raise ConfigError(message, file=path, line=_line_in(path, error), fix=fix) from error
    return module


def _line_in(path: Path, error: BaseException) -> int | None:
    """Return the last line of the file in the error's traceback."""
    if isinstance(error, SyntaxError):
        return error.lineno
    lines = [n for frame, n in walk_tb(error.__traceback__) if frame.f_code.co_filename == str(path)]
    return lines[-1] if lines else None


def _refuse_taken(name: str, found: Mapping[str, Effect], path: Path) -> None:
    if not (isinstance(name, str) and name.isidentifier()):
        reason, fix = f"id {name!r} is not a plain name.", "Use letters, digits and underscores."
    elif name in EFFECTS or name in FREE:
        reason, fix = f"the catalogue has an effect '{name}' already.", "Give it another id."
    elif name in found:
        reason, fix = f"another file of the folder has an effect '{name}' already.", "Rename one."
    else:
        return
    raise ConfigError(reason, file=path, fix=fix)


def contract_fault(effect: Effect) -> str:
    """Return the first violation of the contract by an effect as text, empty if there is none."""
    try:
        with np.errstate(all="ignore"):
            return next(chain(_description_faults(effect), _worked_faults(effect), _shape_faults(effect)), "")
    except Exception as error:  # its shape is the user's code
        return f"its shape fails with its worked inputs: {type(error).__name__}: {error}"


def _description_faults(effect: Effect) -> Iterator[str]:
    for name in ("label", "equation", "source"):
        if not (isinstance(getattr(effect, name), str) and getattr(effect, name).strip()):
            yield f"its {name} is empty"
    if not effect.acts_on:
        yield "acts_on is empty: say on what it may act"
    if not effect.reads:
        yield "reads is empty: name the channels it depends on"
    if {CHANNEL, SECOND} & set(effect.reads) and effect.reads not in READS_ANY:
        yield "reads mixes 'x' or 'z' (any channel) with named channels other than the direction"
    if len({p.name for p in effect.parameters}) != len(effect.parameters):
        yield "two parameters share a name"
    for p in effect.parameters:
        yield from _parameter_faults(p)


def _parameter_faults(p: Parameter) -> Iterator[str]:
    if not np.isfinite(p.bounds).all():
        yield f"the bounds of {p.name} are not finite"
    if not p.linear and isinstance(p.search, str) and p.search not in ("inside", "between", "span", "ratio"):
        yield f"search of {p.name} is '{p.search}': use numbers, 'inside', 'between', 'span' or 'ratio'"


def _worked_faults(effect: Effect) -> Iterator[str]:
    if effect.worked is None:
        yield "it has no worked value"
    inputs, values, _ = effect.worked
    names = {p.name for p in effect.parameters}
    missing = [name for name in effect.reads if name not in inputs]
    if missing:
        yield f"its worked value gives no {', '.join(missing)}"
    if set(values) != names:
        yield f"its worked value gives parameters {sorted(values)}, not {sorted(names)}"


def _shape_faults(effect: Effect) -> Iterator[str]:
    inputs, values, expected = effect.worked
    arrays = {name: np.full(3, value) if name in effect.reads else value for name, value in inputs.items()}
    before = {name: np.copy(value) for name, value in arrays.items()}
    result = effect.shape(arrays, **values)
    if np.shape(result) != (3,):
        yield f"its shape returns an array of shape {np.shape(result)} for three rows"
    if not np.allclose(result, expected, rtol=TOLERANCE, atol=1e-12):
        yield f"its shape gives {result[0]:.10g} where its worked value says {expected:.10g}"
    if any(not np.array_equal(before[name], arrays[name]) for name in before):
        yield "its shape edits its inputs"
    names = ", ".join(effect.linear)
    doubled = effect.shape(arrays, **{**values, **{name: 2 * values[name] for name in effect.linear}})
    if not np.allclose(doubled, 2 * result, rtol=TOLERANCE, atol=1e-12):
        yield f"its shape is not linear in {names}: twice the amplitude must give twice the shape"
    if np.any(effect.shape(arrays, **{**values, **dict.fromkeys(effect.linear, 0.0)}) != 0):
        yield f"its shape is not zero where {names} is zero"
    for p in effect.parameters:
        for bound in p.bounds:
            if not np.isfinite(effect.shape(arrays, **{**values, p.name: bound})).all():
                yield f"its shape is not finite at the bound {p.name} = {bound:g}"
