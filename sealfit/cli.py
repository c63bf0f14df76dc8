"""The commands: paths in, messages out. Everything heavy is imported by the command that needs it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from sealfit import __version__
from sealfit.ending import end, exit_code, print_json
from sealfit.options import (
    Campaign,
    ConfigFile,
    EffectsFolder,
    Force,
    Json,
    Out,
    Profile,
    Results,
    Scheduler,
    Strict,
    Workers,
)

app = typer.Typer(
    help="From a friction rig's CSV files to the LuGre model of an aging rubber seal, and to what that model lacks.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help: rich takes longer to load than all the rest
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sealfit {__version__}")
        raise typer.Exit


@app.callback()
def _sealfit(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    pass


@app.command()
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
    _run(("ingest",), campaign, out, config, workers, scheduler, force, strict, profile, as_json)


@app.command("fit-steady")
def fit_steady(
    out: Results,
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    profile: Profile = False,
    as_json: Json = False,
) -> None:
    """Fit steady LuGre to each condition."""
    _single("fit-steady", out, force, profile, as_json, workers, scheduler)


@app.command("fit-aging")
def fit_aging(
    out: Results,
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    profile: Profile = False,
    as_json: Json = False,
) -> None:
    """Fit the aging law across days."""
    _single("fit-aging", out, force, profile, as_json, workers, scheduler)


@app.command("fit-dynamic")
def fit_dynamic(
    out: Results,
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    profile: Profile = False,
    as_json: Json = False,
) -> None:
    """Fit sigma_0 and sigma_1 to the pre-sliding part."""
    _single("fit-dynamic", out, force, profile, as_json, workers, scheduler)


@app.command("close-loop")
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
    _single("close-loop", out, force, profile, as_json, workers, scheduler, effects_folder=effects_folder)


@app.command()
def report(out: Results, force: Force = False, profile: Profile = False, as_json: Json = False) -> None:
    """Write report.html and its plots."""
    _single("report", out, force, profile, as_json)


@app.command()
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
    """Do every step that is not current, in order."""
    from sealfit.fingerprint import STEPS

    own = {"effects_folder": effects_folder}
    _run(STEPS, campaign, out, config, workers, scheduler, force, strict, profile, as_json, **own)


@app.command()
def predict(
    out: Results,
    points: Annotated[Path, typer.Option("--points", help="CSV of points: condition columns, speed, channels.")],
    output: Annotated[Path, typer.Option("--output", help="CSV to write: the points and their answers.")],
    effects_folder: EffectsFolder = None,
    as_json: Json = False,
) -> None:
    """Answer the force at new points."""
    from sealfit import progress, requests, summary_lines

    made = requests.predict(out, points, output, effects_folder=effects_folder, progress=progress.to_stderr())
    end("predict", made, summary_lines.predict_lines, as_json)


@app.command()
def lifetime(
    out: Results,
    quantity: Annotated[str, typer.Option("--quantity", help="mu_s, mu_c, F_s or F_c.")] = "mu_s",
    threshold: Annotated[float | None, typer.Option("--threshold", help="Value at which life ends.")] = None,
    loss: Annotated[float | None, typer.Option("--loss", help="Or: percent of the start that may be lost.")] = None,
    temperature: Annotated[float | None, typer.Option("--temperature", help="Of use, in degC.")] = None,
    compression: Annotated[float | None, typer.Option("--compression", help="Height in use, in percent.")] = None,
    years: Annotated[float | None, typer.Option("--years", help="Find the temperature that lasts so long.")] = None,
    law: Annotated[str | None, typer.Option("--law", help="log, stretched, power, induction.")] = None,
    model: Annotated[str, typer.Option("--model", help="after (with the loop's effects) or before.")] = "after",
    as_json: Json = False,
) -> None:
    """Tell the days until a quantity reaches a threshold."""
    from sealfit import requests, summary_life

    asked = {"quantity": quantity, "threshold": threshold, "loss_pct": loss, "law": law, "model": model}
    asked |= {"temperature_C": temperature, "compression_pct": compression, "years": years}
    end("lifetime", requests.lifetime(out, **asked), summary_life.lifetime_lines, as_json)


@app.command()
def effects(
    out: Annotated[Path | None, typer.Argument(metavar="[OUT]", help="Results, for their units and effects.")] = None,
    effects_folder: EffectsFolder = None,
    as_json: Json = False,
) -> None:
    """List the catalogue of effects."""
    from sealfit import requests, summary_lines

    end("effects", requests.effects(out, effects_folder), summary_lines.effects_lines, as_json)


@app.command()
def simulate(
    spec: Annotated[Path, typer.Argument(metavar="SPEC.toml", help="What to simulate (TOML).")],
    out: Annotated[Path, typer.Option("--out", help="Campaign folder to write; the truth goes beside it.")],
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier simulated campaign.")] = False,
    as_json: Json = False,
) -> None:
    """Write a campaign with known truth."""
    from sealfit import requests

    made = requests.simulate(spec, out, force=force)
    end("simulate", made, lambda m: [f"{m['files']} trace files in {m['campaign']}", f"truth: {m['truth']}"], as_json)


@app.command()
def check(
    campaign: Campaign,
    config: ConfigFile = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """List every fault of a campaign, write nothing."""
    count = _workers(workers, scheduler)
    from sealfit import progress, requests, summary_lines

    found, faults = requests.check(campaign, config, workers=count, scheduler=scheduler, progress=progress.to_stderr())
    if as_json:
        print_json({"ok": not faults, "command": "check", **found, "errors": [fault.as_dict() for fault in faults]})
    else:
        for fault in faults:
            typer.echo(f"{fault.severity}: {fault}")
        for line in summary_lines.ingest_lines(found) if found["files"] else ():
            typer.echo(line)
        typer.echo(
            f"{len(faults)} {'fault' if len(faults) == 1 else 'faults'} found." if faults else "No faults found."
        )
    if faults:
        raise typer.Exit(1)


# ---------------------------------------------------------------- what the commands share
def _run(
    names: tuple[str, ...],
    campaign: Path,
    out: Path,
    config: Path | None,
    workers: int | None,
    scheduler: str | None,
    force: bool,
    strict: bool,
    profile: bool,
    as_json: bool,
    **options: Path | None,
) -> None:
    count = _workers(workers, scheduler)
    options |= {"workers": count, "scheduler": scheduler, "force": force, "strict": strict}
    command = "ingest" if len(names) == 1 else "run"
    _do(
        command,
        profile,
        as_json,
        lambda steps, progress: steps.run(campaign, out, config, steps=names, progress=progress, **options),
    )


def _single(
    step: str,
    out: Path,
    force: bool,
    profile: bool,
    as_json: bool,
    workers: int | None = None,
    scheduler: str | None = None,
    **options: Path | None,
) -> None:
    options |= {"workers": _workers(workers, scheduler), "scheduler": scheduler, "force": force}
    _do(step, profile, as_json, lambda steps, progress: steps.single(step, out, progress=progress, **options))


def _do(command: str, profile: bool, as_json: bool, work: Callable) -> None:
    """Do steps, with progress, and print what they came to."""
    from sealfit import profiling, progress, steps, summary_lines

    with profiling.profiled() as parts:
        made = work(steps, progress.to_stderr())
    if profile:
        made["profile"] = profiling.as_dicts(parts)
    end(command, made, lambda made: summary_lines.lines(made) + profiling.lines(made.get("profile", ())), as_json)


def _workers(workers: int | None, scheduler: str | None) -> int:
    """Return how many processes of this computer to use."""
    from sealfit import engine

    if workers is not None and scheduler is not None:
        raise typer.BadParameter("use either --workers (this computer) or --scheduler (a Dask cluster), not both.")
    return workers or engine.cores()


def main() -> None:
    """Run the command line; the exit code is 0, 1 (input or request), 2 (usage), 70 (a bug) or 130 (Ctrl-C)."""
    sys.exit(exit_code(app))


if __name__ == "__main__":
    main()
