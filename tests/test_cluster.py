"""A real Dask scheduler and two local workers: the same results as here, also where a worker is killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas.testing as pdt
import pytest

pytest.importorskip("distributed")

from dask import config as dask_config
from dask_here import DaskHere

from sealfit.cli import app, exit_code
from sealfit.closure import loop
from sealfit.engine.run_map import Cluster, on_cluster, run_map
from sealfit.errors import RequestError, WorkerError
from sealfit.ingest import partitions
from sealfit.pipeline import MADE, STEPS, TABLES, run
from sealfit.progress import Silent
from sealfit.simulation import load_spec, simulate
from sealfit.store import Store

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent


@pytest.fixture(scope="module")
def one_cluster(tmp_path_factory):
    """A scheduler and two workers, stopped in the end."""
    made = DaskHere(tmp_path_factory.mktemp("dask"), workers=2, paths=(HERE, ROOT / "benchmarks"))
    try:
        yield made.wait()
    finally:
        made.stop()


@pytest.fixture
def dask(one_cluster):
    """A cluster whose workers a test may kill."""
    return one_cluster.mend()


def square(number):
    return number * number


def slow_square(number):
    time.sleep(0.2)
    return number * number


def wrong(number):
    raise RequestError(f"{number} is wrong.", fix="Use another.")


def timed_out(number):
    raise TimeoutError("too slow")


def answer_late(number):
    time.sleep(0.02 * (number % 7))
    return number


def fatal(number):
    os._exit(1)


def test_a_map_runs_on_the_cluster_in_order(dask):
    with on_cluster(str(dask.file)):
        assert list(run_map(square, range(50))) == [n * n for n in range(50)]
        pids = {worker.pid for worker in dask.workers}
        assert set(run_map(process_id, range(20), together=1)) <= pids
        with pytest.raises(RequestError, match="0 is wrong"):
            list(run_map(wrong, range(3)))
    assert set(run_map(process_id, range(3))) == {os.getpid()}


def process_id(_):
    return os.getpid()


def test_an_answer_that_comes_as_the_wait_ends_is_taken(dask, monkeypatch):
    monkeypatch.setattr("sealfit.engine.run_map.LOOK_S", 0.02)
    with on_cluster(str(dask.file)):
        assert list(run_map(answer_late, range(120), together=1)) == list(range(120))
        with pytest.raises(TimeoutError, match="too slow"):
            list(run_map(timed_out, range(2)))


def test_a_map_survives_a_killed_worker(dask):
    with on_cluster(str(dask.file)):
        made = run_map(slow_square, range(30), together=1)
        first = [next(made) for _ in range(5)]
        dask.workers[0].send_signal(signal.SIGKILL)
        assert first + list(made) == [n * n for n in range(30)]


def test_work_that_kills_every_worker_and_a_cluster_without_workers_are_clear_errors(dask, monkeypatch):
    monkeypatch.setattr("sealfit.engine.run_map.ALONE_S", 3.0)
    with on_cluster(str(dask.file)), pytest.raises(WorkerError, match=r"no workers left.*start them again"):
        list(run_map(fatal, range(1)))
    no_workers = pytest.raises(RequestError, match=r"has no workers\. Start one: dask worker")
    with no_workers, on_cluster(str(dask.file)):
        pytest.fail("it has none")


def test_a_folder_that_workers_do_not_see_is_refused(dask, tmp_path):
    with (
        pytest.raises(RequestError, match=r"does not see the folder.*all workers share"),
        on_cluster(str(dask.file), tmp_path / "nowhere"),
    ):
        pass


def test_no_scheduler_is_a_clear_error(monkeypatch):
    monkeypatch.setattr("sealfit.engine.run_map.CONNECT_S", 0.5)
    with pytest.raises(RequestError, match=r"no Dask scheduler answers at tcp://127.0.0.1:1\. Start one"):
        Cluster("tcp://127.0.0.1:1")


def test_what_is_no_scheduler_is_said_at_once(tmp_path):
    with pytest.raises(RequestError, match=r"'foo' is not an address of a scheduler\. Write tcp://host:8786"):
        Cluster("foo")
    for text in ("{}", "[" * 4_000 + "]" * 4_000):
        (tmp_path / "scheduler.json").write_text(text)
        with pytest.raises(RequestError, match=r"scheduler\.json is not a scheduler file"):
            Cluster(str(tmp_path / "scheduler.json"))


# ---------------------------------------------------------------- the whole pipeline
class KillsAt(Silent):
    """Kills a worker when the first part has been read, or the first fold is waited for."""

    def __init__(self, victim, at):
        self.victim, self.at, self.killed = victim, at, ""

    def say(self, text):
        if self.at in text:
            self._kill(text)

    def counting(self, what):
        import contextlib

        def on_file(done, total):
            if self.at == what and done < total:
                self._kill(f"{done} of {total}")

        return contextlib.nullcontext(on_file)

    def _kill(self, when):
        if not self.killed:
            self.killed = when
            self.victim.send_signal(signal.SIGKILL)


def results(out):
    store = Store.open(out)
    tables = {name: store.read(name) for name in TABLES}
    return tables, json.loads((out / "closure.json").read_text("utf-8"))


def assert_same_results(out, tables, closure):
    there, closed = results(out)
    for name, table in tables.items():
        pdt.assert_frame_equal(there[name], table, check_exact=True, obj=name)
    assert closed == closure
    assert len(there["inputs"]) == there["inputs"]["file"].nunique()


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Some 50 files with an effect that the loop finds, so that the folds search too."""
    folder = tmp_path_factory.mktemp("cluster")
    spec = load_spec(ROOT / "sample_data" / "simulated.spec.toml")
    design = spec.design.model_copy(update={"temperatures_C": (60.0,), "days": (1.0, 4.0), "max_rows": 150})
    simulate(spec.model_copy(update={"design": design}), folder / "c")
    (folder / "rig.toml").write_text("[loop]\nfolds = 2\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(partitions, "PART_FILES", 12)
        patch.setattr(loop, "JACKKNIFE_UNITS", 6)  # so that the folds search, few runs as there are
        patch.setattr(loop, "CERTAIN_P", 0.0)  # and sure as the effect is
        run(folder / "c", folder / "here", folder / "rig.toml", steps=STEPS[:-1], workers=1)
    return folder / "c", folder / "rig.toml", results(folder / "here")


OPENSSL = shutil.which("openssl")


@pytest.mark.long
@pytest.mark.skipif(OPENSSL is None, reason="no openssl on PATH to make a certificate")
def test_over_tls_only_who_has_the_certificate_connects(campaign, tmp_path, monkeypatch, capsys):
    key, cert = tmp_path / "key.pem", tmp_path / "cert.pem"
    make = f"req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=here -keyout {key} -out {cert}"
    subprocess.run([OPENSSL, *make.split()], check=True, capture_output=True)
    ours = {"require-encryption": True, "tls.ca-file": str(cert)}
    for role in ("scheduler", "worker", "client"):
        ours |= {f"tls.{role}.cert": str(cert), f"tls.{role}.key": str(key)}
    ours = {f"distributed.comm.{name}": value for name, value in ours.items()}
    with monkeypatch.context() as patch:
        for name, value in ours.items():
            spelled = name.upper().replace("-", "_").replace(".", "__")
            patch.setenv(f"DASK_{spelled}", str(value))
        made = DaskHere(tmp_path, workers=1, protocol="tls")

    def checked(scheduler):
        monkeypatch.setattr(sys, "argv", ["sealfit", "check", str(campaign[0]), "--scheduler", scheduler])
        return exit_code(app), capsys.readouterr().err

    try:
        until = time.monotonic() + 60
        while not made.file.exists() and time.monotonic() < until:
            time.sleep(0.2)
        address = json.loads(made.file.read_text("utf-8"))["address"]
        assert address.startswith("tls://")
        with dask_config.set(ours):
            inside = checked(str(made.file))
            while "has no workers" in inside[1] and time.monotonic() < until:  # they join after the scheduler
                inside = checked(str(made.file))
            bare = checked(address.replace("tls", "tcp"))
        outside = checked(str(made.file))
    finally:
        made.stop()
    assert inside[0] == 0, inside[1]
    assert outside[0] == bare[0] == 1
    assert "asks for a certificate, and none is set here" in outside[1]
    assert "is not encrypted" in bare[1]


def test_files_read_on_a_cluster_give_the_same_although_a_worker_is_killed(
    campaign, tmp_path, dask, monkeypatch
):
    folder, rig, (here, _) = campaign
    monkeypatch.setattr(partitions, "PART_FILES", 12)
    kills = KillsAt(dask.workers[1], "reading trace files")
    run(folder, tmp_path / "there", rig, steps=("ingest",), scheduler=str(dask.file), progress=kills)
    assert kills.killed
    there = Store.open(tmp_path / "there")
    for name in MADE["ingest"]:
        pdt.assert_frame_equal(there.read(name), here[name], check_exact=True, obj=name)


def test_the_pipeline_on_a_cluster_gives_the_same_although_a_worker_is_killed(
    campaign, tmp_path, dask, monkeypatch
):
    folder, rig, (here, closure) = campaign
    monkeypatch.setattr(partitions, "PART_FILES", 12)
    monkeypatch.setattr(loop, "JACKKNIFE_UNITS", 6)
    monkeypatch.setattr(loop, "CERTAIN_P", 0.0)
    kills = KillsAt(dask.workers[1], "fold 1 of")
    run(folder, tmp_path / "there", rig, steps=STEPS[:-1], scheduler=str(dask.file), progress=kills)
    assert kills.killed
    assert_same_results(tmp_path / "there", here, closure)


# ---------------------------------------------------------------- the end of the scheduler
def test_a_lost_scheduler_is_a_clear_error_wherever_it_is_missed(dask):
    """The last test of this file, as it leaves no scheduler."""
    with on_cluster(str(dask.file)):
        made = run_map(slow_square, range(30), together=1)
        next(made)
        dask.scheduler.kill()
        dask.scheduler.wait()
        for missed in (lambda: list(made), lambda: list(run_map(square, range(3)))):
            with pytest.raises(
                WorkerError, match=r"went away\. Look at the scheduler, and run the command again"
            ):
                missed()
