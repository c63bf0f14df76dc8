"""The suite of faults: the disk it stands for, by hand, and a short form of it."""

import errno
import os
import pickle
import subprocess
import sys
from pathlib import Path
from random import Random

import faults
import pytest
from faults import forked
from faulty_disk import KILLED, Disk

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/fd").exists(), reason="the names of open files are needed"
)

SCRIPT = Path(faults.__file__)
SYNCED, UNSYNCED, OLD = b"synced", b"not synced", b"old"


def write(folder):
    """Make two files, one of them synced, and rename both onto old ones; sync the folder after the first."""
    for name, content, synced in (("a", SYNCED, True), ("b", UNSYNCED, False)):
        with (folder / f"{name}.new").open("wb") as file:
            file.write(content)
            file.flush()
            if synced:
                os.fsync(file.fileno())
        os.replace(folder / f"{name}.new", folder / name)
        if name == "a":
            handle = os.open(folder, os.O_RDONLY)
            os.fsync(handle)
            os.close(handle)


def on_disk(tmp_path, at, fault):
    """Return the folder, exit code, calls and journal after `write` with a fault at a call."""
    work = tmp_path / "work"
    work.mkdir()
    (work / "a").write_bytes(OLD)
    (work / "b").write_bytes(OLD)

    def do():
        disk = Disk(work, at, fault, tmp_path / "report")
        disk.install()
        try:
            write(work)
        except OSError as error:
            return error.errno
        finally:
            disk.end()
        return 0

    ended = forked(do, tmp_path)
    return work, ended.code, *pickle.loads((tmp_path / "report").read_bytes())


CALLS = ["open", "write", "fsync", "rename", "fsync", "open", "write", "rename"]


def test_every_call_that_changes_a_file_is_counted(tmp_path):
    work, code, calls, _ = on_disk(tmp_path, 0, "")
    assert (code, calls) == (0, CALLS)
    assert {path.name: path.read_bytes() for path in work.iterdir()} == {"a": SYNCED, "b": UNSYNCED}


@pytest.mark.parametrize(("fault", "number"), [("eio", errno.EIO), ("enospc", errno.ENOSPC)])
@pytest.mark.parametrize("at", [1, 2, 4])
def test_a_call_fails_with_its_error(tmp_path, at, fault, number):
    work, code, *_ = on_disk(tmp_path, at, fault)
    assert code == number
    assert (work / "a").read_bytes() == OLD


def test_a_short_write_is_written_on_and_a_kill_leaves_half(tmp_path):
    work, code, *_ = on_disk(tmp_path, 2, "short")
    assert (code, (work / "a").read_bytes()) == (0, SYNCED)
    (tmp_path / "two").mkdir()
    work, code, *_ = on_disk(tmp_path / "two", 2, "kill")
    assert (code, (work / "a.new").read_bytes()) == (KILLED, SYNCED[:3])


@pytest.mark.parametrize(
    ("variant", "left"), [("nothing", {"a": SYNCED, "b": OLD}), ("names", {"a": SYNCED, "b": b""})]
)
def test_a_power_loss_keeps_what_was_synced_and_no_more(tmp_path, variant, left):
    *_, journal = on_disk(tmp_path, len(CALLS) + 1, "power")
    (tmp_path / "after").mkdir()
    journal.rebuild(tmp_path / "after", variant, Random(1))
    assert {path.name: path.read_bytes() for path in (tmp_path / "after").iterdir()} == left


UNSAFE = """
import sys
sys.path[:0] = {paths!r}
from pathlib import Path
import faults
from sealfit.store import staged_writes

faults.hold_time()
faults.remember_computations()
folder = Path({folder!r})
scene = faults.make_scene("fit-aging --values", folder)
(folder / "job").mkdir()
after_the_end = faults.Point(scene.name, len(scene.calls) + 1, "power", "names", 1)
print(repr(faults.judge(scene, after_the_end, folder / "job" / "work").wrong))
staged_writes.sync = lambda path: None
after_the_end = faults.replace(after_the_end, at=1000)
print(faults.judge(scene, after_the_end, folder / "job" / "work").wrong)
"""


def test_a_store_that_does_not_sync_is_found(tmp_path):
    paths = [str(SCRIPT.parent), str(SCRIPT.parents[1])]
    program = UNSAFE.format(paths=paths, folder=str(tmp_path))
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    sound, unsound = run.stdout.splitlines()
    assert sound == "''"
    assert unsound.endswith("is neither the old nor the new one (0 bytes)") or "no JSON" in unsound


@pytest.mark.long
def test_the_short_form():
    scenes = ["--scenes", "fit-aging --values", "predict", "fit-steady"]
    words = ["--points", "12", "--limits", "0", "--kills", "0", "--jobs", "1", "--seed", "5"]
    run = subprocess.run(
        [sys.executable, str(SCRIPT), *scenes, *words],  # not in tmp_path, which other users cannot enter
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "12 points in" in run.stdout
    assert "no locks: 6, 0 wrong" in run.stdout
    assert "read-only folder: 3, 0 wrong" in run.stdout


@pytest.mark.parametrize("limit_MB", [150, 500])
def test_a_run_without_memory_is_one_line(tmp_path, limit_MB):
    def limited():
        faults.resource.setrlimit(faults.resource.RLIMIT_AS, (limit_MB << 20, limit_MB << 20))

    campaign = SCRIPT.parents[2] / "sample_data" / "simulated"
    words = ["run", str(campaign), "--out", str(tmp_path / "out"), "--workers", "2"]
    ended = faults.subprocess_ended([sys.executable, "-m", "sealfit", *words], preexec_fn=limited)
    assert ended.of_library() or (ended.code == 1 and not ended.fault())
