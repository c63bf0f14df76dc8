"""How a command ends: what it prints, as text or as one JSON object, and its exit code."""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Callable

import typer

from sealfit.errors import SealfitError
from sealfit.threads import one_thread

BUG = 70  # EX_SOFTWARE of sysexits.h
INTERRUPTED = 130  # 128 + SIGINT, as shells report it


def end(command: str, made: dict, lines: Callable[[dict], list[str]], as_json: bool) -> None:
    """Print what `command` made: itself as JSON, or its `lines`."""
    if as_json:
        print_json({"ok": True, "command": command, **made})
    else:
        typer.echo("\n".join(lines(made)))


def print_json(document: dict) -> None:
    """Print exactly one JSON object."""
    from sealfit.state import to_json

    typer.echo(to_json(document), nl=False)


def exit_code(app: typer.Typer) -> int:
    """Run the command line and say how it ended: 0, 1 (input or request), 2 (usage), 70 (a bug) or 130 (Ctrl-C)."""
    one_thread()
    try:
        code = app(standalone_mode=False, prog_name="sealfit") or 0
        return _interrupted() if code == INTERRUPTED else code
    except SealfitError as error:
        return _fail(f"sealfit: {error}", error.as_dicts(), 1)
    except (KeyboardInterrupt, typer.Abort):  # typer hands on a Ctrl-C as one of these or as the code, by version
        return _interrupted()
    except BrokenPipeError:  # `sealfit effects | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        # Faults of usage. Typer brings its own copy of click, or uses click, by version: told by what they can do.
        if not (hasattr(error, "format_message") and hasattr(error, "exit_code")):
            return _bug(error)
        text = error.format_message()
        if "NoArgs" in type(error).__name__:  # `sealfit` alone: its message is the help
            return _fail(text, [_error("no command was given.")], error.exit_code)
        usage = error.ctx.get_usage() if getattr(error, "ctx", None) else ""
        hint = f"Try: {error.ctx.command_path} --help" if usage else ""
        shown = "\n".join(part for part in (usage, hint, f"sealfit: {text}") if part)
        return _fail(shown, [_error(text)], error.exit_code)


def _fail(message: str, errors: list[dict], code: int) -> int:
    if "--json" in sys.argv[1:]:
        print(json.dumps({"ok": False, "errors": errors}, indent=1, ensure_ascii=False, allow_nan=False))
    print(message, file=sys.stderr)
    return code


def _bug(error: Exception) -> int:
    """Say that the program, not its input, is at fault: the traceback on stderr, one line of it under --json."""
    traceback.print_exception(error)
    told = " ".join("".join(traceback.format_exception_only(error)).split())
    fix = "Please report it, with the traceback on stderr."
    return _fail(f"sealfit: this is a bug. {fix}", [{**_error(told), "kind": "bug", "fix": fix}], BUG)


def _interrupted() -> int:
    text = "interrupted; what was complete before is kept."
    return _fail(f"sealfit: {text}", [_error(text)], INTERRUPTED)


def _error(reason: str) -> dict:
    return {"file": None, "line": None, "column": None, "value": None, "fix": "", "reason": reason}
