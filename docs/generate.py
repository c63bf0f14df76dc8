"""Write the pages of docs/reference that follow from the program: commands, config, tables, effects.

    python docs/generate.py            write them
    python docs/generate.py --check    exit 1 if one is not as it would be written

They are committed, so that they can be read without building the documentation.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import typer
from pydantic import BaseModel
from pydantic_core import PydanticUndefined
from typer.cli import get_docs_for_click
from typer.main import get_command

from sealfit.cli import app
from sealfit.config import Config
from sealfit.effects import EFFECTS as CATALOGUE
from sealfit.report.summary import of_effects
from sealfit.tables import SCHEMAS
from sealfit.units import Units

REFERENCE = Path(__file__).resolve().parent / "reference"


def table(*rows: tuple[str, ...]) -> list[str]:
    """Return a Markdown table; the first row is its head."""
    lines = ["| " + " | ".join(cell.replace("|", r"\|") for cell in row) + " |" for row in rows]
    return [lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]


def commands() -> str:
    """Return the page of the commands, with the text of their help."""
    context = typer.Context(get_command(app), info_name="sealfit")
    text = get_docs_for_click(obj=get_command(app), ctx=context, name="sealfit", title="Commands")
    return text.strip() + "\n\n" + COMMON.strip() + "\n"


def config() -> str:
    """Return the page of the config, a table for each of its sections."""
    lines = ["# The config", "", *INTRODUCTION.strip().splitlines(), ""]
    sections = {name: f.annotation for name, f in Config.model_fields.items() if _is_model(f.annotation)}
    for title, model in {"": Config, **sections}.items():
        if title:
            lines += [f"## `[{title}]`", "", model.__doc__.strip().splitlines()[0], ""]
        keys = [
            (f"`{name}`", _default(field), " ".join(field.description.split()))
            for name, field in model.model_fields.items()
            if name not in sections or title
        ]
        lines += [*table(("key", "default", "meaning"), *keys), ""]
    return "\n".join([*lines, *EXPRESSIONS.strip().splitlines()]) + "\n"


def _is_model(annotation: object) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _default(field) -> str:
    """Return the default of a key as it would be written in TOML."""
    value = field.default if field.default is not PydanticUndefined else field.default_factory()
    if value is None:
        return "none"
    if isinstance(value, dict):
        return "`{}`" if not value else "the three of a trace file"
    text = {True: "true", False: "false"}[value] if isinstance(value, bool) else repr(value)
    return "`" + text.replace("'", '"') + "`"


def tables() -> str:
    """Return the page of the tables of OUT."""
    lines = ["# Tables", "", *TABLES.strip().splitlines(), ""]
    for name, schema in SCHEMAS.items():
        if name.endswith("_after"):
            continue
        lines += [f"## `{name}`", ""]
        rows = [
            (f"`{c.name}`", Units().of(c.name) or c.unit, str(c.dtype), c.meaning) for c in schema.columns
        ]
        lines += [*table(("column", "unit", "type", "meaning"), *rows), ""]
        if schema.open_:
            lines += ["The campaign's condition columns and channels are added.", ""]
    return "\n".join(lines)


def effects() -> str:
    """Return the page of the catalogue of effects."""
    lines = ["# Effects", "", *EFFECTS.strip().splitlines(), ""]
    for effect, listed in zip(CATALOGUE.values(), of_effects(CATALOGUE.values(), Units()), strict=True):
        lines += [f"## `{effect.id}`", "", f"{effect.label[0].upper()}{effect.label[1:]}:", ""]
        lines += [f"    h = {effect.form}", ""]
        targets = ", ".join(f"{operation} on {quantity}" for quantity, operation in effect.acts_on)
        lines += [f"- Reads: {', '.join(effect.reads) or 'a channel x'}.", f"- Acts by: {targets}."]
        for p in listed["parameters"]:
            unit = f" ({p['unit']})" if p["unit"] else ""
            lines += [f"- `{p['name']}`{unit}: {p['meaning']}."]
        lines += [f"- Source: {effect.source}", ""]
    return "\n".join(lines)


COMMON = """
## Common to all commands

- Results go to stdout; progress, warnings and faults go to stderr. With `--json` stdout is exactly one JSON
  object, also on failure: `{"ok": false, "errors": [{"file", "line", "column", "value", "fix", "reason"}]}`.
  A fault of the data also has `check`, `stroke`, `severity` and `action`.
- Exit codes: 0 success (whatever the verdict), 1 faulty input or request, or any fault that `check` finds, 2
  wrong usage, 70 a bug (traceback on stderr; please report it), 130 Ctrl-C.
- Without `--strict` a faulty row or file is left out and listed in the summary, the report and the table
  `quality`. A faulty cell of the table of runs always stops the command.
- The results do not depend on `--workers` or `--scheduler`. The latter takes `tcp://host:8786` or a scheduler
  file and needs `pip install 'sealfit[cluster]'`: [on a cluster](../how-to/cluster.md).
- **Python is run from `--effects-folder`**: [your own effects](../how-to/own-effects.md).
"""

INTRODUCTION = """
`--config rig.toml` describes a rig. Without it the files must be as in [the campaign folder](campaign.md).
`configs/` has configs of real rigs, and `sealfit init` drafts one. Unknown keys are refused, with the nearest
one that exists.
"""

EXPRESSIONS = """
## Expressions

`compute` and `keep` know `+ - * / **`, parentheses, `pi`, `abs`, `sqrt`, `exp`, `log`, `sin`, `cos`, `tanh`,
`sign`, `min`, `max`, `where`, comparisons with `and`, `or`, `not` (1 or 0 in a number), columns, parts of the
file name and constants. A text is compared with `==` or `!=`: `keep = "status == 'ok'"`. `days(tested_on)` is
the number of the day of a date (ISO 8601 or 17.04.2025). They are not run as Python.
"""

TABLES = """
Every table is `OUT/<name>.parquet`. The Parquet metadata of each column holds its unit and meaning as well;
where a config declares another quantity, the true unit stands there. [The folder OUT](results.md) says what
a row of each table is. A table `<name>_after` has the columns of `<name>`, with the effects of the loop
taken out, and without the files that it left out. `steady_after` also has `effects_N` (mean force of the
subtracted effects over the steady window), `effects_start_N` (their force at the start of the stroke) and
`effects_u1_N`, ... (its change by one standard error in each direction in which the effects are uncertain).
"""

EFFECTS = """
What the loop can add to the model by name. h is the change: by `add` it is added to the quantity, by
`multiply` the quantity is multiplied by 1 + h. `sealfit effects` prints the same list. An effect that none
of these describes is a free shape of its channels (`smooth`, `surface`, `levels`, `slopes`). [Add your
own](../how-to/own-effects.md).
"""

PAGES = {"commands.md": commands, "config.md": config, "tables.md": tables, "effects.md": effects}


def main() -> int:
    """Write all pages, or say which are out of date."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--check", action="store_true")
    check = arguments.parse_args().check
    stale = []
    for name, page in PAGES.items():
        path, text = REFERENCE / name, page()
        if not check:
            path.write_text(text, "utf-8")
        elif not path.is_file() or path.read_text("utf-8") != text:
            stale.append(name)
    if stale:
        print(f"out of date: {', '.join(stale)}. Run: python docs/generate.py", file=sys.stderr)
    return bool(stale)


if __name__ == "__main__":
    sys.exit(main())
