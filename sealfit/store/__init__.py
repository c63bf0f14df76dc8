"""The OUT folder: its tables, and whether each step is current or stale."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from sealfit import __version__
from sealfit.config import Config, Files
from sealfit.engine import undisturbed
from sealfit.errors import ConfigError, OutError, RequestError, StaleError, did_you_mean, disk, quoted
from sealfit.store import manifest
from sealfit.store.manifest import STATE, ConfigCopy, Fingerprint, Properties, State, fingerprint, to_json
from sealfit.store.paths import OPTION, effect_hashes, effects_seen, needed, own_effects_folder
from sealfit.store.staged_writes import COMPLETE, PARQUET, PROVENANCE, Staged, file_size, held

if TYPE_CHECKING:
    import pandas as pd

    from sealfit.ingest.stored_parts import StoredTraces


class Store:
    """One OUT folder with the campaign and the config it belongs to; `kept` is the state as stored."""

    def __init__(self, out: Path, state: State, kept: State | None, effects: Path | None):
        self.out, self.state, self._kept, self.effects = out, state, kept, effects
        config = state.config.parse()
        self._names_effects = config.loop.effects_folder is not None
        own = {"effects_folder": None if effects is None else str(effects)}  # that of the command line only
        self.config: Config = config.model_copy(update={"loop": config.loop.model_copy(update=own)})
        self.warnings: list[str] = []
        self._checksums: dict[str, str | None] = {}  # of files that this process has read
        self._keys: dict[str, str] | None = None  # of every step for the present campaign
        self._opened: tuple | None = None  # status of state.json when it was opened for reading
        found = _status_of(out)
        self._written_ns = found[-1] if found else 0  # when state.json was last written before this process
        self._changed: Mapping[str, Fingerprint] = {}  # inputs that are new or changed since the stored state
        if state.campaign.is_dir():
            files = self.config.files if state.properties is None else Files()
            self._changed = manifest.changes(state.campaign, state.inputs, files)
        else:
            what = f"the campaign folder {state.campaign} is missing, so changes cannot be detected."
            self.warnings.append(what)
        self.marks = state.inputs | self._changed  # the present files of the campaign

    # ------------------------------------------------------------ opening
    @classmethod
    def open(cls, out: Path, effects: Path | None = None) -> Store:
        """Return the results in `out`, for reading; `effects` is the folder that --effects-folder names.

        OutError, whose fix names the likeliest folder, if `out` holds no results. ConfigError if `effects`
        may not be run, as `own_effects_folder`.
        """
        if (out / COMPLETE).exists():
            with held(out):  # which moves its files
                return cls.open(out, effects)
        opened = _status_of(out)  # before it is read
        state = State.read(out)
        if state is None:
            what = "holds no results of sealfit." if out.is_dir() else "there is no such folder."
            fix = did_you_mean(out, lambda folder: (folder / STATE).is_file())
            make = f"Make it: sealfit run CAMPAIGN --out {quoted(out)}"
            if out.is_dir() and any(out.iterdir()):  # something else, such as the campaign
                make = "Give the folder of the results, or make it: sealfit run CAMPAIGN --out OUT"
            raise OutError(what, file=out, fix=fix or make)
        effects = own_effects_folder(effects, None, out, state.campaign)
        config = state.config.now()
        hashes = effects_seen(effects, state, config)
        store = cls(out, replace(state, config=config, own_effects=hashes), state, effects)
        store._opened = opened
        return store

    @classmethod
    @contextlib.contextmanager
    def writing(
        cls,
        out: Path,
        campaign: Path | None = None,
        source: ConfigCopy | None = None,
        effects: Path | None = None,
        properties: Properties | None = None,
    ) -> Iterator[Store]:
        """Hold `out` as its only writer and give the store; without `campaign`, one that already has results.

        `source` is the config that the command line names, `effects` the folder that --effects-folder names,
        `properties` what is asked of a table of properties in `campaign`.

        OutError if `out` is a file, a folder that sealfit did not make, the results of another campaign, in
        use by another process, or cannot be written.
        """
        if campaign is None:
            cls.open(out, effects)  # raises if there are no results
        with held(out):
            if campaign is None or source is None:
                store = cls.open(out, effects)
                store._opened = None
            else:
                folder = own_effects_folder(effects, source, out, campaign)
                hashes = {} if folder is None else effect_hashes(folder)
                asked = State(campaign.resolve(), source, properties, own_effects=hashes)
                store = cls._of_campaign(out, asked, folder)
            store._keep_what_moved()
            yield store

    @classmethod
    def _of_campaign(cls, out: Path, asked: State, effects: Path | None) -> Store:
        """Return the store of the campaign and config of `asked`, with what `out` has of it already."""
        kept, campaign = State.read(out), asked.campaign
        table, former = (own.properties.table if own and own.properties else None for own in (asked, kept))
        if kept is None or (not kept.steps and (kept.campaign != campaign or former != table)):
            return cls(out, asked, kept, effects)
        if former != table:
            what = f"the campaign {kept.campaign}" if former is None else f"the table {former}"
            raise OutError(f"holds the results of {what}.", file=out, fix="Choose another --out.")
        state = replace(asked, inputs=kept.inputs, steps=kept.steps)
        if kept.campaign == campaign:
            return cls(out, state, kept, effects)
        inputs = {name: fingerprint(campaign / name) for name in kept.inputs}
        if any(mark.sha256 != kept.inputs[name].sha256 for name, mark in inputs.items()):
            what = f"belongs to the campaign {kept.campaign}, and {campaign} holds other data."
            raise OutError(what, file=out, fix="Choose another --out.")
        store = cls(out, replace(state, inputs=inputs), kept, effects)
        same = f"{campaign} holds the same data and takes over."
        store.warnings.append(f"{out} was made from {kept.campaign}; {same}")
        return store

    def _keep_what_moved(self) -> None:
        """Store a new path of the campaign, new times of unchanged files, and an equivalent config."""
        kept, known = self._kept, self.state.inputs
        if kept is None:
            return
        same = {n: mark for n, mark in self._changed.items() if _same_content(mark, known.get(n))}
        self.state = replace(self.state, inputs=known | same)
        source = self.state.config if _same_config(kept.config, self.state.config) else kept.config
        tidy = replace(self.state, config=source, own_effects=kept.own_effects)
        if tidy != kept:
            staged = Staged(self.out, self.config.units, "state")
            try:
                staged.file(STATE, to_json(tidy.as_dict(), indent=None))
                with disk(self.out):
                    staged.replace_state()
            finally:
                staged.clear()

    def changed_effects(self) -> str:
        """Return what to say of the user's own effects that are not those of the results; "" of none."""
        kept, now = self._kept.own_effects if self._kept is not None else {}, self.state.own_effects
        names = sorted(name for name in kept.keys() | now.keys() if kept.get(name) != now.get(name))
        return f"your own effects are not those it was made with ({_first(names)})" if names else ""

    # ------------------------------------------------------------ current or stale
    def why_stale(self, step: str) -> str:
        """Return the reason why `step` is out of date, or "" if it is current."""
        if self._keys is None:
            self._keys = manifest.step_keys(self.state, self.marks, self.config)
        for name in self.up_to(step):
            done = self.state.steps.get(name)
            if done is None:
                return f"{name} has not been done"
            if done.key != self._keys[name]:
                return f"{name} is stale: {self._what_changed(name, done)}"
            for file in done.files:
                if not self.is_whole(file, done):
                    return f"{name} is stale: its {file} is missing or was changed"
        return ""

    def up_to(self, step: str) -> tuple[str, ...]:
        """Return the steps up to `step`, in order; RequestError if these results have no such step."""
        order = self.state.order
        if step not in order:
            laws = f"the aging laws of {self.state.properties.table}, which has no traces"
            fix = f"Its steps are {' and '.join(order)}; sealfit lifetime asks its laws."
            raise RequestError(f"{self.out} holds {laws}: there is no {step}.", fix=fix)
        return order[: order.index(step) + 1]

    def is_whole(self, file: str, done: manifest.Done) -> bool:
        """Whether a file is what its step wrote; it is read once by this process.

        Parts of large tables are read only if they were touched since state.json was written.
        """
        if file_size(f"{self.out}/{file}") != done.files[file]:
            return False
        if file not in done.checksums or (file.endswith(PARQUET) and "/" in file and not self._touched(file)):
            return True
        if file not in self._checksums:
            self._checksums[file] = fingerprint(self.out / file).sha256
        return self._checksums[file] == done.checksums[file]

    def _touched(self, file: str) -> bool:
        try:
            return (self.out / file).stat().st_ctime_ns > self._written_ns
        except OSError:
            return True

    def _what_changed(self, step: str, done: manifest.Done) -> str:
        if done.version != __version__:
            return f"it was made by sealfit {done.version}, this is {__version__}"
        known = self.state.inputs
        changed = sorted(n for n, mark in self._changed.items() if not _same_content(mark, known.get(n)))
        if changed:
            return f"inputs changed ({_first(changed)})"
        if self._kept is not None and self._kept.properties != self.state.properties:
            return "other columns are asked for"
        own = self.changed_effects() if step == "close-loop" else ""
        return own or f"the config ({self.state.config.name}) changed"

    def require(self, step: str) -> None:
        """Raise StaleError, naming the command to run, unless `step` and all before it are current."""
        for name in self.up_to(step):
            if why := self.why_stale(name):
                raise StaleError(f"{why}.", file=self.out, fix=f"Run: {self.command(name)}")

    def require_effects(self) -> None:
        """Raise RequestError if the loop needs the user's own effects and no folder of them is given."""
        if self.effects is None and (self._names_effects or self.state.own_effects):
            raise needed("the loop is closed with", self.state.own_effects)

    def command(self, step: str) -> str:
        """Return the command line that does `step`."""
        out = quoted(self.out)
        if step != self.state.order[0]:
            own = self.effects or ("FOLDER" if self._names_effects or self.state.own_effects else None)
            option = f" {OPTION} {quoted(own)}" if own and step == "close-loop" else ""
            return f"sealfit {step} {out}{option}"
        config = f" --config {quoted(self.state.config.path)}" if self.state.config.path else ""
        if (asked := self.state.properties) is not None:
            names = "".join(f" --property {quoted(name)}" for name in asked.names)
            batch = f" --batch {quoted(asked.batch)}" if asked.batch != manifest.BATCH else ""
            table = quoted(self.state.campaign / asked.table)
            return f"sealfit fit-aging --values {table} --out {out}{config}{names}{batch}"
        return f"sealfit ingest {quoted(self.state.campaign)} --out {out}{config}"

    # ------------------------------------------------------------ reading
    def read(self, table: str, columns: list[str] | None = None, **which: object) -> pd.DataFrame:
        """Return a table, or those columns of it; `which` as `parquet.read`."""
        from sealfit.store import parquet

        try:
            return parquet.read(self._parts_of(table) or self.out / f"{table}{PARQUET}", columns, **which)
        finally:
            self._require_unchanged()

    def _require_unchanged(self) -> None:
        """Raise OutError if another process has written since this one opened OUT for reading.

        The folder of a complete step is there before any file changes, and state.json changes last.
        """
        written = (self.out / COMPLETE).exists() or _status_of(self.out) != self._opened
        if self._opened is not None and written:
            raise OutError("was written while it was read.", file=self.out, fix="Run the command again.")

    def _parts_of(self, table: str) -> list[Path]:
        files = (file for done in self.state.steps.values() for file in done.files)
        return [self.out / file for file in files if file.startswith(f"{table}{PARQUET}/")]

    def traces(self) -> list[StoredTraces]:
        """Return where table `traces` lies, in groups of whole conditions."""
        from sealfit.ingest.stored_parts import ARROW, PARTS, by_conditions
        from sealfit.store import parquet

        conditions = {}
        for path in self._parts_of("traces"):
            strokes = parquet.read_ipc((self.out / PARTS / path.name).with_suffix(ARROW))
            conditions[path] = strokes["condition"].drop_null().unique().to_pylist()
        return by_conditions(conditions)

    def read_json(self, name: str) -> dict:
        """Return closure.json ("closure") or model.json ("model"); OutError if no loop writes such a one."""
        from sealfit.store.documents import read_document

        try:
            return read_document(name, (self.out / f"{name}.json").read_text("utf-8"))
        except (ValueError, RecursionError) as error:
            raise self.not_ours(name) from error
        finally:
            self._require_unchanged()

    def not_ours(self, name: str) -> OutError:
        """Return the error of a document that no loop writes."""
        fix = f"Run: {self.command('close-loop')} --force"
        return OutError("is not what sealfit wrote.", file=self.out / f"{name}.json", fix=fix)

    def seen_config(self, step: str) -> Config:
        """Return the config as `step` uses it."""
        return manifest.seen_config(step, self.config)

    # ------------------------------------------------------------ writing
    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[Staged]:
        """Give a place for the files of step `name`; all are moved when the block ends without an error.

        OutError if the disk is full or refuses; OUT then holds what it held before.
        """
        began = time.monotonic()
        staged = Staged(self.out, self.config.units, name)
        try:
            yield staged
            self._commit(name, staged, time.monotonic() - began)
        finally:
            staged.clear()

    def _commit(self, name: str, staged: Staged, seconds: float) -> None:
        inputs = self.state.inputs if staged.inputs is None else staged.inputs
        # Copied, as the files below are those of no step.
        files, checksums, steps = dict(staged.files), dict(staged.checksums), self.state.steps
        now = datetime.now(UTC).isoformat(timespec="seconds")
        key = manifest.step_keys(self.state, inputs, self.config)[name]
        done = manifest.Done(key, __version__, now, round(seconds, 3), files, checksums)
        earlier = {step: steps[step] for step in self.up_to(name)[:-1] if step in steps}
        state = replace(self.state, inputs=inputs, steps={**earlier, name: done})
        staged.file(STATE, to_json(state.as_dict(), indent=None))
        staged.file(PROVENANCE, to_json(manifest.provenance(state), indent=None))
        with undisturbed(), disk(self.out):
            staged.commit()
            self.state = state
        self._checksums |= done.checksums
        if staged.inputs is not None:
            self.marks, self._changed, self._keys = inputs, {}, None


def _status_of(out: Path) -> tuple | None:
    """Return what tells a state.json from any other; None without one."""
    try:
        status = os.stat(out / STATE)
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _first(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _same_content(mark: Fingerprint, known: Fingerprint | None) -> bool:
    return known is not None and mark.sha256 == known.sha256


def _same_config(kept: ConfigCopy, config: ConfigCopy) -> bool:
    try:
        return kept.parse() == config.parse()
    except ConfigError:
        return False
