"""The commands: paths in, messages out. Everything heavy is imported by the command that needs it."""

import errno
import json
import os
import shlex
import sys
import traceback
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option
from typer.core import TyperCommand

from sealfit import __version__
from sealfit.engine import one_thread
from sealfit.errors import (
    MEMORY,
    MORE_MEMORY,
    SealfitError,
    grouped,
    memory_ran_out,
    printable,
    shortened,
    told,
)

# ---------------------------------------------------------------- options that several commands share

Campaign = Annotated[Path, Argument(metavar="CAMPAIGN", help="Folder of runs.csv and trace files.")]
OUT = Argument(metavar="OUT", help="Folder of results of `run`, or of the steps before.")
Results = Annotated[Path, OUT]
Out = Annotated[Path, Option("--out", help="Folder of results; created if it is missing.")]
ConfigFile = Annotated[Path | None, Option("--config", help="Rig config (TOML); else the default.")]
Workers = Annotated[int | None, Option("--workers", min=1, help="Processes. [default: all cores]")]
Scheduler = Annotated[
    str | None, Option("--scheduler", metavar="ADDRESS", help="Dask scheduler: tcp://host:port, or its file.")
]
Force = Annotated[bool, Option("--force", help="Redo steps that are up to date, too.")]
Strict = Annotated[bool, Option("--strict", help="Stop with exit code 1 at any fault of the campaign.")]
Profile = Annotated[bool, Option("--profile", help="Print seconds and rows per step.")]
EffectsFolder = Annotated[
    Path | None, Option("--effects-folder", metavar="FOLDER", help="Your own effects. Python is run from it.")
]
Json = Annotated[bool, Option("--json", help="Print exactly one JSON object on stdout.")]


# ---------------------------------------------------------------- what a command prints, and its exit code

FORBIDDEN = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP)  # what the system refuses to open
BUG = 70  # EX_SOFTWARE of sysexits.h
INTERRUPTED = 130  # 128 + SIGINT, as shells report it
INTERRUPTION = "interrupted; what was complete before is kept."
REPORT = "Please report it, with the traceback on stderr."


def end(command: str, made: dict, lines: Callable[[dict], list[str]], as_json: bool) -> None:
    """Print what `command` made: itself as JSON, or its `lines`."""
    if as_json:
        print_json({"ok": True, "command": command, **made})
    else:
        typer.echo("\n".join(map(printable, lines(made))))


def print_json(document: dict) -> None:
    """Print exactly one JSON object, in ASCII: a terminal obeys control characters."""
    from sealfit.store.manifest import to_json

    typer.echo(to_json(document, ensure_ascii=True), nl=False)


def exit_code(app: typer.Typer) -> int:
    """Run the command line and return 0, 1 (input or request), 2 (usage), 70 (a bug) or 130 (Ctrl-C)."""
    one_thread()
    try:
        code = app(standalone_mode=False, prog_name="sealfit") or 0
        return code if code != INTERRUPTED else _fail(SealfitError(INTERRUPTION), INTERRUPTED)
    except SealfitError as error:
        return _fail(error)
    except (KeyboardInterrupt, typer.Abort):  # or the code above: which one depends on typer's version
        return _fail(SealfitError(INTERRUPTION), INTERRUPTED)
    except BrokenPipeError:  # `sealfit effects | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if memory_ran_out(error):
            return _fail(SealfitError(MEMORY, fix=MORE_MEMORY))
        if isinstance(error, OSError) and error.errno in FORBIDDEN and error.filename is not None:
            file, reason = os.fsdecode(error.filename), f"there is no access ({error.strerror})."
            fix = "Fix its name or rights, or those of the folders above it."
            return _fail(SealfitError(reason, file=file, fix=fix))
        # Typer brings its own copy of click, or uses click, by version: its errors are known by what they do.
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):
            return _misuse(error)
        traceback.print_exception(error)
        said = " ".join("".join(traceback.format_exception_only(error)).split())
        return _fail(SealfitError("this is a bug.", fix=REPORT), BUG, reason=said, kind="bug")


def _misuse(error: Exception) -> int:
    """Report a fault of usage, with the refused value where the typer in use leaves it out."""
    if refused := getattr(error.__cause__, "errors", lambda: ())():
        error.message = f"{shortened(repr(refused[0]['input']))}: {error.message}"
    text = error.format_message()
    if "NoArgs" in type(error).__name__:  # `sealfit` alone: its message is the help
        return _fail(SealfitError("no command was given."), error.exit_code, above=f"{text}\n\n")
    usage = error.ctx.get_usage() if getattr(error, "ctx", None) else ""
    above = f"{usage}\nTry: {error.ctx.command_path} --help\n" if usage else ""
    return _fail(SealfitError(text), error.exit_code, above=above)


def _fail(error: SealfitError, code: int = 1, *, above: str = "", **known: str) -> int:
    """Print an error, below other text, and return its exit code; under --json as an object, too."""
    if "--json" in sys.argv[1:]:
        errors = [{**one, **known} for one in error.as_dicts()]
        print(json.dumps({"ok": False, "errors": errors}, indent=1, allow_nan=False))
    print(printable(f"{above}sealfit: {error}"), file=sys.stderr)
    return code


class Command(TyperCommand):
    """A command whose usage has its arguments without braces: CAMPAIGN."""

    def collect_usage_pieces(self, ctx: typer.Context) -> list[str]:
        """Return the parts of the line of usage after the name."""
        return [piece.strip("{}") for piece in super().collect_usage_pieces(ctx)]


app = typer.Typer(
    help="From a friction rig's CSV files to the LuGre model of an aging rubber seal, and to what that "
    "model lacks.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help: rich takes longer to load than all the rest
)
command = partial(app.command, cls=Command)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sealfit {__version__}")
        raise typer.Exit


@app.callback()
def _sealfit(
    version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    pass


@command(epilog="Example: sealfit init my_campaign --output rig.toml")
def init(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="Folder with the trace files of a rig.")],
    output: Annotated[Path, Option("--output", help="Config to write (TOML).")] = Path("rig.toml"),
    force: Annotated[bool, Option("--force", help="Replace a config that is there.")] = False,
    as_json: Json = False,
) -> None:
    """Draft a rig config from a folder of files."""
    from sealfit import commands
    from sealfit.draft import summary_lines

    end("init", commands.init(folder, output, force=force), summary_lines, as_json)


@command(epilog="Example: sealfit check my_campaign --config rig.toml")
def check(
    campaign: Campaign,
    config: ConfigFile = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """List every fault of a campaign, write nothing."""
    options = _options(workers, scheduler)
    from sealfit import commands, progress
    from sealfit.report import summary_lines

    found, faults = commands.check(campaign, config, progress=progress.to_stderr(), **options)
    if as_json:
        errors = [fault.as_dict() for fault in faults]
        print_json({"ok": not faults, "command": "check", **found, "errors": errors})
    else:
        for group in grouped(faults):
            typer.echo(f"{group[0].severity}: {told(group)}")
        for line in summary_lines.ingest_lines(found) if found["files"] else ():
            typer.echo(line)
        number = {0: "No faults", 1: "1 fault"}.get(len(faults), f"{len(faults)} faults")
        typer.echo(f"{number} found.")
    if faults:
        raise typer.Exit(1)


@command(epilog="Example: sealfit run my_campaign --config rig.toml --out results")
def run(
    campaign: Campaign,
    out: Out,
    config: ConfigFile = None,
    effects_folder: EffectsFolder = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    strict: Strict = False,
    profile: Profile = False,
    as_json: Json = False,
) -> None:
    """Run all out-of-date steps, in order."""
    options = _options(workers, scheduler, force=force, strict=strict, effects_folder=effects_folder)
    from sealfit import pipeline

    _do("run", profile, as_json, partial(pipeline.run, campaign, out, config, **options))


@command(epilog="Example: sealfit ingest my_campaign --config rig.toml --out results")
def ingest(
    campaign: Campaign,
    out: Out,
    config: ConfigFile = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    strict: Strict = False,
    profile: Profile = False,
    as_json: Json = False,
) -> None:
    """Read a campaign into tables of traces."""
    options = _options(workers, scheduler, force=force, strict=strict)
    from sealfit import pipeline

    _do("ingest", profile, as_json, partial(pipeline.ingest, campaign, out, config, **options))


def _fit_command(step: str, says: str) -> None:
    """Add the command of a fit; these have the same options."""

    @command(step, help=says, epilog=f"Example: sealfit {step} results")
    def fit(
        out: Results,
        workers: Workers = None,
        scheduler: Scheduler = None,
        force: Force = False,
        profile: Profile = False,
        as_json: Json = False,
    ) -> None:
        _single(step, out, profile, as_json, **_options(workers, scheduler, force=force))


_fit_command("fit-steady", "Fit steady LuGre to each condition.")


@command("fit-aging", epilog="Example: sealfit fit-aging --values strength.csv --out results")
def fit_aging(
    out: Annotated[Path | None, OUT] = None,
    values: Annotated[
        Path | None, Option("--values", help="Or a table of property values of specimens.")
    ] = None,
    new: Annotated[Path | None, Option("--out", help="With --values: folder of results.")] = None,
    config: ConfigFile = None,
    properties: Annotated[
        list[str] | None,
        Option("--property", metavar="COLUMN", help="Property; may be repeated, or several with commas."),
    ] = None,
    batch: Annotated[
        str | None, Option("--batch", metavar="COLUMN", help="Batch of a specimen. [default: batch]")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    profile: Profile = False,
    as_json: Json = False,
) -> None:
    """Fit the aging law across days."""
    if values is None:
        if new or config or properties or batch:
            raise typer.BadParameter("--out, --config, --property and --batch go with --values.")
        if out is None:
            raise typer.BadParameter("give OUT, or --values TABLE --out OUT.")
        _single("fit-aging", out, profile, as_json, **_options(workers, scheduler, force=force))
        return
    if (out is None) == (new is None):
        raise typer.BadParameter("give the folder of results once: --values TABLE --out OUT.")
    from sealfit import pipeline
    from sealfit.report import summary_lines

    asked = {"names": tuple(properties or ()), "force": force} | ({"batch": batch} if batch else {})
    work = partial(pipeline.fit_properties, values, new or out, config, **asked)
    _do("fit-aging", profile, as_json, work)
    if not as_json:
        typer.echo(summary_lines.line("next", f"sealfit report {shlex.quote(str(new or out))}"))


_fit_command("fit-dynamic", "Fit sigma_0 and sigma_1 to the pre-sliding part.")


@command("close-loop", epilog="Example: sealfit close-loop results")
def close_loop(
    out: Results,
    effects_folder: EffectsFolder = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    profile: Profile = False,
    as_json: Json = False,
) -> None:
    """Find, name and add what the model lacks."""
    options = _options(workers, scheduler, force=force, effects_folder=effects_folder)
    _single("close-loop", out, profile, as_json, **options)


@command(epilog="Example: sealfit report results --open")
def report(
    out: Results,
    force: Force = False,
    show: Annotated[bool, Option("--open", help="Open the report in the browser.")] = False,
    profile: Profile = False,
    as_json: Json = False,
) -> None:
    """Write report.html and its plots."""
    _single("report", out, profile, as_json, force=force)
    if show:
        typer.launch(str(out / "report.html"))


@command(epilog="Example: sealfit predict results --points points.csv --output answers.csv")
def predict(
    out: Results,
    points: Annotated[Path, Option("--points", help="CSV of points: condition columns, speed, channels.")],
    output: Annotated[Path, Option("--output", help="CSV to write: the points with their predictions.")],
    effects_folder: EffectsFolder = None,
    as_json: Json = False,
) -> None:
    """Predict the force at new points."""
    from sealfit import commands, progress
    from sealfit.report import summary_lines

    made = commands.predict(out, points, output, effects_folder=effects_folder, progress=progress.to_stderr())
    end("predict", made, summary_lines.predict_lines, as_json)


@command(epilog="Example: sealfit lifetime results --quantity mu_s --threshold 0.70 --temperature 40")
def lifetime(
    out: Results,
    quantity: Annotated[str, Option("--quantity", help="mu_s, mu_c, F_s, F_c, or a property.")] = "mu_s",
    threshold: Annotated[float | None, Option("--threshold", help="Value at which the life ends.")] = None,
    loss: Annotated[
        float | None, Option("--loss", help="Or the loss at which it ends, in percent of the start.")
    ] = None,
    temperature: Annotated[float | None, Option("--temperature", help="Temperature in use, in degC.")] = None,
    compression: Annotated[float | None, Option("--compression", help="Height in use, in percent.")] = None,
    years: Annotated[
        float | None, Option("--years", help="Find the temperature at which it lasts so many years.")
    ] = None,
    law: Annotated[str | None, Option("--law", help="log, stretched, power, induction.")] = None,
    model: Annotated[str, Option("--model", help="after (with the loop's effects) or before.")] = "after",
    rubber: Annotated[str | None, Option("--rubber", help="Which one, where several were aged.")] = None,
    as_json: Json = False,
) -> None:
    """Compute the days until a quantity reaches a threshold."""
    from sealfit import commands
    from sealfit.report import summary_lines

    asked = commands.LifetimeRequest(
        quantity, threshold, loss, temperature, compression, years, law, model, rubber
    )
    end("lifetime", commands.lifetime(out, asked), summary_lines.lifetime_lines, as_json)


@command(epilog="Example: sealfit effects results")
def effects(
    out: Annotated[Path | None, Argument(metavar="OUT", help="Results, for their units and effects.")] = None,
    effects_folder: EffectsFolder = None,
    as_json: Json = False,
) -> None:
    """List the catalogue of effects."""
    from sealfit import commands
    from sealfit.report import summary_lines

    end("effects", commands.effects(out, effects_folder), summary_lines.effects_lines, as_json)


@command(epilog="Example: sealfit simulate sample_data/simulated.spec.toml --out my_campaign")
def simulate(
    spec: Annotated[Path, Argument(metavar="SPEC", help="What to simulate (TOML).")],
    out: Annotated[Path, Option("--out", help="Campaign folder to write; the truth goes beside it.")],
    force: Annotated[bool, Option("--force", help="Replace an earlier simulated campaign.")] = False,
    as_json: Json = False,
) -> None:
    """Write a campaign with known truth."""
    from sealfit import commands

    made = commands.simulate(spec, out, force=force)
    lines = [f"{made['files']} trace files in {made['campaign']}", f"truth: {made['truth']}"]
    end("simulate", made, lambda _: lines, as_json)


# ---------------------------------------------------------------- what the commands share
def _single(step: str, out: Path, profile: bool, as_json: bool, **options: object) -> None:
    from sealfit import pipeline

    _do(step, profile, as_json, partial(pipeline.single, step, out, **options))


def _do(command: str, profile: bool, as_json: bool, work: Callable[..., dict]) -> None:
    """Do steps, with progress, and print what they came to."""
    from sealfit import progress
    from sealfit.report import summary_lines

    with progress.profiled() as parts:
        made = work(progress=progress.to_stderr())
    if profile:
        made["profile"] = [asdict(part) for part in parts]

    def lines(made: dict) -> list[str]:
        return summary_lines.lines(made) + progress.lines(made.get("profile", ()))

    end(command, made, lines, as_json)


def _options(workers: int | None, scheduler: str | None, **more: object) -> dict:
    """Return the options of `pipeline.Options`; without `workers`, all cores of this computer."""
    from sealfit.engine import run_map

    if workers is not None and scheduler is not None:
        either = "use either --workers (this computer) or --scheduler (a Dask cluster), not both."
        raise typer.BadParameter(either)
    return {"workers": workers or run_map.cores(), "scheduler": scheduler, **more}
