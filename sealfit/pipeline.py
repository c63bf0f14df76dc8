"""One function per command: read tables from OUT, call the pure functions, write what they return."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sealfit import tables as schemas
from sealfit.engine import claim_memory
from sealfit.engine.run_map import on_cluster
from sealfit.errors import CampaignError, Fault
from sealfit.progress import Silent, timed
from sealfit.store import Store, manifest, paths
from sealfit.store.manifest import BATCH, STEPS, ConfigCopy, Properties, fingerprint
from sealfit.store.staged_writes import Staged

if TYPE_CHECKING:
    import pandas as pd

MADE = {step: tuple(table.name for table in made) for step, made in schemas.MADE.items()}
TABLES = tuple(name for names in MADE.values() for name in names)
OF_PROPERTIES = ("property_values", "aging_fit", "aging_curves", "aging_laws", "master_curve")
BESIDE = tuple(table.name for table in schemas.BESIDE)
UNREPORTED = (  # of many rows, and the report needs nothing of them but a few traces
    "traces", "traces_mean", "bins", "steady_after", *BESIDE, *(f"{name}_after" for name in BESIDE),
)  # fmt: skip

Counted = tuple[int, str]  # how many rows a step worked on, and what they are


@dataclass(frozen=True, slots=True)
class Options:
    """How steps are done."""

    workers: int = 1  # processes of this computer that read trace files, fit and repeat the search
    scheduler: str | None = None  # address or file of a Dask cluster instead; it has to see both folders
    force: bool = False  # do current steps too
    strict: bool = False  # stop at any fault of the campaign, after the first step
    effects_folder: Path | None = None  # of the user's own effects, which is run; before that of the config


def run(
    campaign: Path,
    out: Path,
    config: Path | None = None,
    *,
    steps: tuple[str, ...] = STEPS,
    progress: Silent | None = None,
    **options,
) -> dict:
    """Run the out-of-date steps among `steps`, in order, and return the summary of all of them.

    `options` are fields of `Options`. SealfitError for whatever the user has to fix.
    """
    chosen, source = Options(**options), ConfigCopy.at(config)
    checked = source.parse()
    own = paths.own_effects_folder(chosen.effects_folder, source, out, campaign)  # before OUT is made
    folder = paths.campaign_folder(campaign, checked)
    with Store.writing(out, folder, source, own) as store, on_cluster(chosen.scheduler, folder, out):
        return _do_steps(store, steps, chosen, progress or Silent())


def ingest(campaign: Path, out: Path, config: Path | None = None, **options) -> dict:
    """Read the campaign into OUT and return the summary; arguments as `run`."""
    return run(campaign, out, config, steps=("ingest",), **options)


def fit_properties(
    table: Path,
    out: Path,
    config: Path | None = None,
    *,
    names: tuple[str, ...] = (),
    batch: str = BATCH,
    progress: Silent | None = None,
    **options,
) -> dict:
    """Fit the aging laws of properties of specimens, without traces, and return the summary.

    The table is a CSV, Excel or Parquet file with a row per specimen; `names` and `batch` are as those of
    `sealfit.ingest.property_table.read_properties`, and all else as for `run`.
    """
    chosen, source = Options(**options), ConfigCopy.at(config)
    source.parse()
    table = paths.existing_file(table, "table of values").resolve()
    asked = Properties(table.name, tuple(names), batch)
    with Store.writing(out, table.parent, source, properties=asked) as store:
        return _do_steps(store, ("fit-aging",), chosen, progress or Silent())


def single(step: str, out: Path, *, progress: Silent | None = None, **options) -> dict:
    """Do one step after the first in an OUT whose earlier steps are current, and return its summary.

    StaleError if a step before it is missing or stale; it names the command to run. RequestError if close-
    loop needs the user's own effects and no `effects_folder` is given.
    """
    chosen = Options(**options)
    with Store.writing(out, effects=chosen.effects_folder) as store, on_cluster(chosen.scheduler, out):
        for before in store.up_to(step)[:-1][-1:]:
            store.require(before)
        return _do_steps(store, (step,), chosen, progress or Silent())


def _do_steps(store: Store, steps: tuple[str, ...], options: Options, progress: Silent) -> dict:
    from sealfit.report import summary

    claim_memory()
    for warning in store.warnings:
        progress.warn(warning)
    done = []
    for step in steps:
        why = store.why_stale(step)
        if why or options.force:
            if why and step in store.state.steps:
                progress.say(why)
            with timed(step) as part, store.step(step) as staged, progress.working(step):
                part.rows, part.of = _WORK[step](store, staged, options, progress)
            done.append(step)
        else:
            progress.say(f"{step}: current, not redone")
        if step == "ingest" and options.strict and (faults := faults_of(store.read("quality"))):
            raise CampaignError(faults)
    with timed("summary"):
        found = summary.of_steps(store, steps)
    return {"out": str(store.out), "done": done, **found}


def faults_of(quality: pd.DataFrame) -> list[Fault]:
    """Return the faults that a quality table holds; rows of severity "info" are none."""
    return [Fault.of_row(row) for row in quality[quality["severity"] != "info"].to_dict("records")]


# ---------------------------------------------------------------- the work of each step


def _ingest(store: Store, staged: Staged, options: Options, progress: Silent) -> Counted:
    with timed("loading libraries"):
        from sealfit.ingest.campaign import Place, ingest_campaign
        from sealfit.ingest.stored_parts import known_parts

    campaign, config = store.state.campaign, store.seen_config("ingest")
    # As they were when the reading began.
    runs_before = {name: fingerprint(campaign / name) for name in paths.possible_tables(config)}
    done = store.state.steps.get("ingest")
    known = {}
    if done and not options.force:
        known = known_parts(store.out, done.files, partial(store.is_whole, done=done))
    place = Place(staged.folder(), known, store.marks)
    with progress.counting("reading trace files") as on_file:
        ingested = ingest_campaign(campaign, config, workers=options.workers, on_file=on_file, place=place)
    progress.faults(ingested.faults)
    with timed("writing tables"):
        for name, table in ingested.tables.items():
            staged.table(name, table)
    staged.adopt(ingested.stored)
    marks = ingested.marks
    named = {fault.file for fault in ingested.faults if fault.file}
    named.update(manifest.glob_names(campaign, config.files))
    # Missing or unreadable: if that changes, the campaign has changed.
    marks |= {name: fingerprint(campaign / name) for name in sorted(named - marks.keys())}
    staged.inputs = marks | runs_before
    return int(ingested.tables["inputs"]["rows"].sum()), "samples"


def _fit_steady(store: Store, staged: Staged, options: Options, progress: Silent) -> Counted:
    from sealfit.fit.steady import fit_conditions

    steady = store.read("steady")
    progress.say(f"fitting {steady['condition'].nunique()} conditions")
    _write(staged, fit_conditions(steady, store.seen_config("fit-steady")))
    return len(steady), "strokes"


def _fit_properties(store: Store, staged: Staged, progress: Silent) -> Counted:
    from sealfit.fit.aging.property import fit_properties
    from sealfit.ingest.property_table import read_properties

    asked, config = store.state.properties, store.seen_config("fit-aging")
    path = store.state.campaign / asked.table
    staged.inputs = {asked.table: fingerprint(path)}  # as it was when the reading began
    specimens, faults = read_properties(path, config, asked.names, asked.batch)
    progress.faults(faults)
    progress.say("fitting the aging law")
    _write(staged, {"property_values": specimens, **fit_properties(specimens, config)})
    return len(specimens), "values"


def _fit_aging(store: Store, staged: Staged, options: Options, progress: Silent) -> Counted:
    if store.state.properties is not None:
        return _fit_properties(store, staged, progress)
    from sealfit.fit.aging import aging_curves, fit_series
    from sealfit.fit.aging.all_series import joint_laws

    config = store.seen_config("fit-aging")
    no_law = "no aging_days in the condition: there is no aging law to fit"
    progress.say("fitting the aging law" if config.aging else no_law)
    steady_fit = {name: store.read(name) for name in MADE["fit-steady"]}
    fitted = fit_series(steady_fit, config)
    laws, curve = joint_laws(store.read("steady"), steady_fit, config)
    curves = aging_curves(fitted)
    _write(staged, {**fitted, "aging_laws": laws, "master_curve": curve, "aging_curves": curves})
    return int(steady_fit["steady_fit"]["condition"].nunique()), "conditions"


def _fit_dynamic(store: Store, staged: Staged, options: Options, progress: Silent) -> Counted:
    from sealfit.fit.dynamic import fit_dynamic

    progress.say("fitting the pre-sliding part")
    steady, config = store.read("steady"), store.seen_config("fit-dynamic")
    steady_fit = {name: store.read(name) for name in MADE["fit-steady"]}
    _write(staged, fit_dynamic(store.traces(), steady, steady_fit, config, workers=options.workers))
    return len(steady), "strokes"


def _close_loop(store: Store, staged: Staged, options: Options, progress: Silent) -> Counted:
    from sealfit.closure.after import after_fits
    from sealfit.closure.loop import close_loop

    store.require_effects()
    config = store.seen_config("close-loop")
    workers, bins = options.workers, store.read("bins")
    closure = close_loop(bins, store.traces(), config, workers=workers, on_progress=progress.say)
    left_out = bool(closure.document["outlier_files"])
    if closure.tables["effects"].size or left_out:
        progress.say("the fits with the effects taken out")
    steady, traces = store.read("steady"), store.traces()
    after = after_fits(closure.after, steady, traces, config, left_out=left_out, workers=workers)
    with timed("writing tables"):
        _write(staged, {**closure.tables, **after})
    started = store.read("runs", ["started_at"])["started_at"].dropna()
    first = min(started, key=_instant) if len(started) else None
    staged.file("model.json", manifest.to_json({**closure.model, "first_started_at": first}))
    staged.file("closure.json", manifest.to_json(closure.document))
    return len(closure.tables["residuals_before"]), "bins"


def _write(staged: Staged, tables: Mapping[str, pd.DataFrame]) -> None:
    for name, table in tables.items():
        staged.table(name, table)


def _instant(text: str) -> datetime:
    """Return the instant of a time as `runs` has it; one without a zone counts as UTC, as in `elapsed_h`."""
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)


def _report(store: Store, staged: Staged, options: Options, progress: Silent) -> Counted:
    from sealfit.report.page import build_report

    progress.say("drawing the report")
    with timed("reading tables"):
        tables, closure = reported(store)
    with timed("page"):
        report = build_report(tables, closure, manifest.provenance(store.state), store.seen_config("report"))
    with timed("writing plots", rows=len(report.figures), of="plots"):
        for name, drawn in report.figures.items():
            for form, content in drawn.items():
                staged.file(f"plots/{name}.{form}", content)
    staged.file("report.html", report.html)
    return sum(len(table) for table in tables.values()), "rows of tables"


def reported(store: Store) -> tuple[dict[str, pd.DataFrame], dict | None]:
    """Return the tables of the report, and closure.json (None of properties); OutError if they disagree."""
    if store.state.properties is not None:
        return {name: store.read(name) for name in OF_PROPERTIES}, None
    tables = {name: store.read(name) for name in TABLES if name not in UNREPORTED}
    tables |= _example_traces(store, tables["runs"])
    closure = store.read_json("closure")
    if tables["shapes"]["effect"].nunique() > len(closure["effects"]):
        raise store.not_ours("closure")
    return tables, closure


def _example_traces(store: Store, runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the averaged traces that the report draws, and repeats of them, as both tables are large."""
    from sealfit.report.figures.aging import MOST_REPEATS, example_runs

    names = ["run_id", "condition"]
    places = store.read("traces_mean", names, coded=names).drop_duplicates("run_id").astype(object)
    chosen = example_runs(places, runs)["run_id"].tolist()
    means = store.read("traces_mean", where={"run_id": chosen})
    means = means.sort_values("run_id", key=lambda names: names.map(chosen.index), kind="stable")
    used = runs.loc[runs["used"].astype(bool) & runs["run_id"].isin(chosen)]
    strokes = used.groupby("run_id").head(MOST_REPEATS)[["file", "stroke", "run_id", "direction"]]
    names, files = ["file", "stroke", "displacement_mm", "force_N"], strokes["file"].unique().tolist()
    return {"traces_mean": means, "traces": strokes.merge(store.read("traces", names, where={"file": files}))}


_WORK: dict[str, Callable[[Store, Staged, Options, Silent], Counted]] = {
    "ingest": _ingest,
    "fit-steady": _fit_steady,
    "fit-aging": _fit_aging,
    "fit-dynamic": _fit_dynamic,
    "close-loop": _close_loop,
    "report": _report,
}
