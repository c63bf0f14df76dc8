"""Commands that keep nothing in OUT: init, check, predict, lifetime, effects and simulate."""

import shlex
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sealfit.engine.run_map import on_cluster
from sealfit.errors import CampaignError, Fault, OutError, ParameterError, RequestError, StaleError
from sealfit.pipeline import MADE
from sealfit.progress import Silent
from sealfit.store import Store, paths
from sealfit.store.manifest import ConfigCopy
from sealfit.store.paths import OPTION, own_effects_folder
from sealfit.store.staged_writes import replace_file
from sealfit.units import Units

if TYPE_CHECKING:
    import pandas as pd

    from sealfit.fit.aging.joint_law import JointLaw
    from sealfit.fit.steady import SteadyFit

MODELS = ("after", "before")  # with the loop's effects taken out at their reference, and without effects


def init(folder: Path, output: Path, *, force: bool = False) -> dict:
    """Write the draft of a config that reads the files in a folder; return guesses, doubts and what is next.

    OutError if `output` is there already and `force` is not given, is no .toml file, or cannot be written.
    RequestError if there is no such folder, or no trace file in it that is text.
    """
    from sealfit.draft import draft

    if output.suffix.lower() != ".toml":
        fix = "Give --output a name that ends in .toml."
        raise OutError("is no name for a config.", file=output, fix=fix)
    if output.exists() and not force:
        fix = "Choose another --output, or replace it with --force."
        raise OutError("is there already.", file=output, fix=fix)
    made = draft(folder)
    replace_file(output, made.text)
    found = {"config": str(output), "folder": str(folder), "files": made.files, "motion": made.motion}
    guesses, doubts = [asdict(guess) for guess in made.guesses], [doubt.as_dict() for doubt in made.doubts]
    command = shlex.join(["sealfit", "check", str(folder), "--config", str(output)])
    return {**found, "guesses": guesses, "doubts": doubts, "next": command}


def check(
    campaign: Path,
    config: Path | None = None,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Silent | None = None,
) -> tuple[dict, list[Fault]]:
    """Read everything, write nothing, and return what was found and every fault."""
    from sealfit.ingest.campaign import ingest_campaign
    from sealfit.report import summary

    source = ConfigCopy.at(config)
    checked = source.parse()
    own_effects_folder(None, source, campaign)
    try:
        folder = paths.campaign_folder(campaign, checked)
        with on_cluster(scheduler, folder), (progress or Silent()).counting("reading trace files") as on_file:
            ingested = ingest_campaign(folder, checked, workers=workers, on_file=on_file)
    except CampaignError as error:
        return {"files": None}, list(error.faults)
    return summary.of_ingest(ingested.tables), ingested.faults


def predict(
    out: Path,
    points: Path,
    output: Path,
    *,
    effects_folder: Path | None = None,
    progress: Silent | None = None,
) -> dict:
    """Write the answers to `points` (CSV) to `output` (CSV); return how many rows, and the effects in them.

    `effects_folder`, which holds the user's own effects, is run. StaleError if the loop has not been closed
    on the campaign as it stands, or with other effects. RequestError if the points cannot be read or lack a
    column, or the user's own effects are needed and not given. OutError if the answers cannot be written.
    """
    from sealfit.closure.prediction_csv import points_of, read_points, write_answers

    store = Store.open(out, effects_folder)
    for warning in store.warnings:
        (progress or Silent()).warn(warning)
    store.require("close-loop")
    asked = read_points(points)
    try:
        answers = answers_to(points_of(asked), store)
    except RequestError as error:
        place = {"file": points, "line": 1} if error.column else {}
        raise RequestError(error.message, column=error.column, fix=error.fix, **place) from error
    effects = [one["label"] for one in store.read_json("closure")["effects"] if not one["candidate"]]
    written = write_answers(asked, answers, output, given=points)
    return {"out": str(store.out), "output": str(output), **written, "includes": effects}


def answers_to(points: "pd.DataFrame", store: Store) -> "pd.DataFrame":
    """Return points with their answers, by the model that `store`'s loop recorded; errors as `predict`."""
    from sealfit.closure.predict import predict as answer
    from sealfit.effects.user import load_user_effects

    try:
        return answer(store.read_json("model"), points, load_user_effects(store.effects))
    except ParameterError as error:  # of a model that no loop writes
        raise store.not_ours("model") from error


@dataclass(frozen=True, slots=True)
class LifetimeRequest:
    """What `lifetime` is asked."""

    quantity: str = "mu_s"
    threshold: float | None = None  # value at which the life ends
    loss_pct: float | None = None  # or loss, in percent of the start
    temperature_C: float | None = None
    compression_ratio_pct: float | None = None
    years: float | None = None  # seek the temperature at which a seal lasts so long
    law: str | None = None  # None: the likeliest one
    model: str = "after"
    rubber: str | None = None  # needed where several were aged


def require_model(name: str) -> None:
    """Raise RequestError unless `name` is one of the two models."""
    if name not in MODELS:
        raise RequestError(f"there is no model '{name}'.", fix=f"Choose one of: {', '.join(MODELS)}.")


def lifetime(out: Path, asked: LifetimeRequest) -> dict:
    """Return the days to a threshold of a quantity, by the likeliest law and by its rivals, with intervals.

    StaleError if the fits of the model are stale. RequestError if the request does not fit the campaign.
    """
    from sealfit.fit.aging.joint_law import rivals_of
    from sealfit.fit.aging.lifetime import answer, finite_ends, goal_of, over_laws, unknown_scatter

    store = Store.open(out)
    require_model(asked.model)
    goal, years = goal_of(asked.threshold, asked.loss_pct), asked.years
    if goal.value is not None and goal.value <= 0 and store.state.properties is None:
        reason = f"--threshold {goal.value:g} is never reached: friction is above 0."
        raise RequestError(reason, fix="Give a positive number.")
    laws, taken_out, notes = _laws_of(store, asked, asked.model)
    place = {"temperature_C": asked.temperature_C, "compression_ratio_pct": asked.compression_ratio_pct}
    chosen, rivals = answer(laws[0], goal, years, resample=True, **place), []
    if asked.law is None:
        rivals = [answer(rival, goal, years, **place) for rival in rivals_of(laws)]
        if years is None:
            chosen["ci95_over_laws"] = finite_ends(over_laws(laws, goal, **place))
    model = asked.model if store.state.properties is None else None  # a property has one model only
    said = {"out": str(store.out), "quantity": asked.quantity, "model": model, "effects": taken_out}
    said["notes"] = [*notes, *unknown_scatter(laws[0])]
    before = None
    if taken_out:
        with suppress(RequestError):  # the declared model may have no answer where this one has
            before = answer(_laws_of(store, asked, "before")[0][0], goal, years, **place)
    return {**said, **chosen, "rivals": rivals, "before": before}


def _laws_of(
    store: Store, asked: LifetimeRequest, model: str
) -> "tuple[list[JointLaw], list[dict], list[str]]":
    """Return the laws of a quantity by BIC, the effects taken out of its values, and remarks on these."""
    if store.state.properties is not None:
        from sealfit.fit.aging.property import laws_of_property

        store.require("fit-aging")
        values = _of_rubber(store.read("property_values"), asked.rubber)
        return laws_of_property(values, asked.quantity, asked.law), [], []
    from sealfit.fit.aging.all_series import law_of

    (steady, fits), taken_out = _fits_of(store, model)
    steady = _of_rubber(steady, asked.rubber)
    fits = {name: table[table["rubber"].isin(steady["rubber"])] for name, table in fits.items()}
    own = fits["steady_fit"]
    own = own[(own["parameter"] == asked.quantity) & own["identified"].astype(bool)]
    notes = [text for text in own["reason"].fillna("").unique().tolist() if text]
    return law_of(steady, fits, asked.quantity, asked.law), taken_out, notes


def _of_rubber(table: "pd.DataFrame", rubber: str | None) -> "pd.DataFrame":
    """Return the rows of one rubber of a table, or all; RequestError if it has no such rubber."""
    if rubber is None:
        return table
    there = sorted(table["rubber"].unique().tolist())
    if rubber not in there:
        raise RequestError(f"there is no rubber '{rubber}'.", fix=f"Choose one of: {', '.join(there)}.")
    return table[table["rubber"] == rubber]


def _fits_of(store: Store, model: str) -> "tuple[tuple[pd.DataFrame, SteadyFit], list[dict]]":
    """Return a model's table `steady`, the fit of its conditions, and the effects taken out of them."""
    suffix, added = "", []
    try:
        store.require("fit-steady" if model == "before" else "close-loop")
    except StaleError as error:
        if store.why_stale("fit-steady"):
            raise
        other = "or ask the declared model, without effects: --model before"
        raise StaleError(error.message, file=error.file, fix=f"{error.fix} ({other})") from error
    if model == "after":
        closure = store.read_json("closure")
        added = [effect for effect in closure["effects"] if not effect["candidate"]]
        suffix = "_after" if added or closure["outlier_files"] else ""
    fit = {name: store.read(f"{name}{suffix}") for name in MADE["fit-steady"]}
    taken_out = [{key: effect[key] for key in ("id", "label", "reference")} for effect in added]
    return (store.read(f"steady{suffix}"), fit), taken_out


def effects(out: Path | None = None, effects_folder: Path | None = None) -> dict:
    """Return the catalogue; with OUT, in its units and with those that its loop added.

    With `effects_folder`, whose files are run, the user's own effects too. `note` says if OUT has others, or
    some and none are given.
    """
    from sealfit.effects import EFFECTS
    from sealfit.effects.user import load_user_effects
    from sealfit.report import summary

    if out is None:
        known = EFFECTS | load_user_effects(own_effects_folder(effects_folder, None))
        return {"effects": summary.of_effects(known.values(), Units())}
    store = Store.open(out, effects_folder)
    known = EFFECTS | load_user_effects(store.effects)
    closed = not store.why_stale("close-loop")
    added = [effect["id"] for effect in store.read_json("closure")["effects"]] if closed else None
    listed = summary.of_effects(known.values(), store.config.units)
    return {"effects": listed, "added": added, "note": _note_on_effects(store)}


def _note_on_effects(store: Store) -> str | None:
    if "close-loop" in store.state.steps and (why := store.why_stale("close-loop")):
        return f"{why}: which effects the loop added is not known."
    if store.effects is None and store.state.own_effects:
        files = ", ".join(store.state.own_effects)
        return f"your own effects ({files}) are listed only from a folder that you name: add {OPTION} FOLDER."
    return store.changed_effects() or None


def simulate(spec: Path, out: Path, *, force: bool = False) -> dict:
    """Write a campaign with known truth to `out`, and the truth beside it, both whole or not at all.

    OutError if `out` is there already and `force` is not given, or as `sealfit.simulation.simulate`.
    """
    from sealfit.simulation import load_spec, truth_path
    from sealfit.simulation import simulate as make

    loaded = load_spec(paths.existing_file(spec, "spec"))
    if not force and (out.is_file() or (out.is_dir() and any(out.iterdir()))):
        raise OutError("is there already.", file=out, fix="Choose another --out, or replace it with --force.")
    make(loaded, out)
    files = sum(1 for path in out.rglob("*") if path.is_file() and path.name != paths.RUNS)
    return {"campaign": str(out), "truth": str(truth_path(out)), "files": files}
