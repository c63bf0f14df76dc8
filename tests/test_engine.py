import _thread
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sealfit.engine.run_map import START, _apply, cores, in_processes, run_map
from sealfit.errors import CampaignError, Fault, RequestError, WorkerError

HERE = Path(__file__).resolve().parent


def square(number):
    return number * number


def process_id(_):
    return os.getpid()


def nested(number):
    return list(run_map(square, range(number), workers=4))


def fail_on_three(number):
    if number == 3:
        raise RequestError("three is wrong.", file="p.csv", line=4, fix="Use another.")
    return number


def fail_with_faults(number):
    raise CampaignError([Fault("rule", f"{number} is wrong.", file="runs.csv", line=2)])


def die(number):
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def wait_long(number):
    time.sleep(60)


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_items(workers):
    assert list(run_map(square, range(37), workers=workers)) == [n * n for n in range(37)]


def test_one_worker_or_one_item_stay_in_this_process():
    assert set(run_map(process_id, range(5), workers=1)) == {os.getpid()}
    assert set(run_map(process_id, [0], workers=2)) == {os.getpid()}


def test_more_items_go_to_other_processes():
    used = set(run_map(process_id, range(5), workers=2))
    assert os.getpid() not in used
    assert 1 <= len(used) <= 2


def test_a_script_that_calls_it_is_not_run_again_in_each_process(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from math import sqrt\nfrom sealfit.engine.run_map import run_map\n"
        "print(list(run_map(sqrt, [1, 4, 9, 16], workers=2, together=1)))\n"
    )
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert ended.stdout == "[1.0, 2.0, 3.0, 4.0]\n"


def test_no_items_give_nothing():
    assert list(run_map(square, [], workers=3)) == []


def test_a_map_inside_a_worker_needs_no_further_processes():
    assert list(run_map(nested, [2, 3], workers=2)) == [[0, 1], [0, 1, 4]]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_the_function_comes_back_whole(workers):
    with pytest.raises(RequestError, match="three is wrong") as caught:
        list(run_map(fail_on_three, range(8), workers=workers))
    assert (caught.value.file, caught.value.line, caught.value.fix) == ("p.csv", 4, "Use another.")


def test_faults_of_a_campaign_come_back_whole():
    with pytest.raises(CampaignError, match=r"^runs.csv:2: 0 is wrong\.$") as caught:
        list(run_map(fail_with_faults, range(2), workers=2))
    assert caught.value.faults[0].line == 2
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_a_dead_worker_is_a_clear_error():
    with pytest.raises(WorkerError, match=r"worker process died.*--workers 1"):
        list(run_map(die, range(4), workers=2))


def test_cores_is_what_this_process_may_use():
    assert 1 <= cores() <= (os.cpu_count() or 1)


PROGRAM = """
import sys
sys.path.insert(0, {tests!r})
from sealfit.engine.run_map import run_map
from sealfit.engine.run_map import in_processes
from test_engine import wait_long

if __name__ == "__main__":
    print("begun", flush=True)
    try:
        {work}
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
"""
WORK = "list(run_map(wait_long, range(4), workers=2))"
PROCESSES = 4
"""Two workers, the server that starts them, and the resource tracker."""


def descendants_of(pid):
    found = children_of(pid)
    return found + [one for child in found for one in descendants_of(child)]


def children_of(pid):
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(entry.parent.name))
    return found


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc to see the processes")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["ctrl-c", "kill -9"])
def test_no_worker_outlives_its_parent(tmp_path, how):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(tests=str(HERE), work=WORK))
    with subprocess.Popen(
        [sys.executable, program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as run:
        assert run.stdout.readline() == "begun\n"
        until = time.monotonic() + 20
        while len(descendants_of(run.pid)) < PROCESSES and time.monotonic() < until:
            time.sleep(0.05)
        children = descendants_of(run.pid)
        assert len(children) == PROCESSES
        if how == signal.SIGINT:
            os.killpg(run.pid, how)  # as a terminal does: to the whole group
        else:
            os.kill(run.pid, how)
        _, stderr = run.communicate(timeout=20)
    if how == signal.SIGINT:
        assert run.returncode == 130
        assert stderr == "interrupted\n"
    until = time.monotonic() + 20
    while any(map(alive, children)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(alive, children))


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_a_server_that_is_still_loading_does_not_see_ctrl_c(tmp_path):
    (tmp_path / "slow_to_load.py").write_text("import time\nopen('loading', 'w').close()\ntime.sleep(3)\n")
    work = "list(in_processes(wait_long, iter([b'', b'']), 2, load='slow_to_load'))"
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(tests=str(HERE), work=work))
    with subprocess.Popen(
        [sys.executable, program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
    ) as run:
        until = time.monotonic() + 20
        while not (tmp_path / "loading").exists() and time.monotonic() < until:
            time.sleep(0.05)
        assert (tmp_path / "loading").exists()
        os.killpg(run.pid, signal.SIGINT)
        _, stderr = run.communicate(timeout=20)
    assert (run.returncode, stderr) == (130, "interrupted\n")


def test_ctrl_c_waits_until_the_processes_have_started():
    chunks = []

    def interrupted():
        for number in range(2):
            _thread.interrupt_main()  # as a signal that another thread takes, whatever this one blocks
            chunks.append(number)
            yield pickle.dumps((square, [number]))

    with pytest.raises(KeyboardInterrupt):
        list(in_processes(_apply, interrupted(), 2, load=__name__))
    assert chunks == [0, 1]


def test_a_map_that_is_given_up_ends_its_processes():
    given_up = run_map(square, range(6), workers=2)
    assert next(given_up) == 0
    given_up.close()
    for _ in range(100):
        if not multiprocessing.active_children():
            break
        time.sleep(0.1)
    assert not multiprocessing.active_children()


@pytest.mark.skipif(START != "forkserver", reason="no server starts processes here")
def test_a_death_of_the_server_that_starts_workers_is_a_clear_error(tmp_path):
    (tmp_path / "deadly_to_load.py").write_text("import os\nos._exit(1)\n")
    work = "list(in_processes(wait_long, iter([b'', b'']), 2, load='deadly_to_load'))"
    (tmp_path / "program.py").write_text(PROGRAM.format(tests=str(HERE), work=work))
    run = subprocess.run(
        [sys.executable, tmp_path / "program.py"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
    )
    assert "WorkerError: a worker process died before it had answered" in run.stderr


NO_ROOM = """
import resource
from sealfit.engine import LEAST_MEMORY, claim_memory, one_thread
one_thread()
import scipy.linalg
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + LEAST_MEMORY // 2, used + LEAST_MEMORY // 2))
try:
    claim_memory()
except MemoryError:
    print("no room")
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the size of a process is not known here")
def test_no_room_for_the_buffers_of_linear_algebra_is_said_and_not_waited_for():
    run = subprocess.run([sys.executable, "-c", NO_ROOM], capture_output=True, text=True, timeout=60)
    assert run.stdout == "no room\n", run.stderr
