"""A Dask scheduler and workers as processes of this computer, for tests and measurements of `--scheduler`."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from sealfit.engine.run_map import Cluster
from sealfit.errors import RequestError

ROOT = Path(__file__).resolve().parents[1]
START_S = 60.0


class DaskHere:
    """A scheduler and workers without nannies: a worker that is killed stays dead.

    Parameters
    ----------
    folder : Path
        For the scheduler file (`file`), the log and what the workers put down.
    workers : int
        How many, of one thread each.
    paths : tuple of Path
        Where the workers find modules beside those that are installed.
    protocol : str
        "tcp", or "tls" with its options in the environment.
    """

    def __init__(
        self, folder: Path, workers: int = 2, paths: tuple[Path, ...] = (), protocol: str = "tcp"
    ) -> None:
        self.file, self._paths = folder / "scheduler.json", paths
        self._log = (folder / "log.txt").open("w")
        scheduler = f"--host {protocol}://127.0.0.1 --port 0 --no-dashboard --scheduler-file"
        self.scheduler = self._start("dask_scheduler", f"{scheduler} {self.file}")
        self._worker = (
            f"--scheduler-file {self.file} --nthreads 1 --no-nanny --no-dashboard --local-directory {folder}"
        )
        self.workers = [self._start_worker(number) for number in range(workers)]

    def _start_worker(self, number: int) -> subprocess.Popen:
        return self._start("dask_worker", f"{self._worker} --name worker-{number}")

    def _start(self, what: str, options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.{what}", *options.split()]
        paths = os.pathsep.join(str(path) for path in (*self._paths, ROOT))
        environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(command, stdout=self._log, stderr=self._log, env=environment, cwd=ROOT)

    def wait(self) -> DaskHere:
        """Return when all workers are there.

        Raises
        ------
        TimeoutError
            If they do not come.
        """
        until = time.monotonic() + START_S
        while time.monotonic() < until:
            if self.file.exists():
                try:
                    cluster = Cluster(str(self.file))
                except RequestError:
                    continue
                there = cluster.threads()
                cluster.close()
                if there == len(self.workers):
                    return self
            time.sleep(0.2)
        raise TimeoutError("the workers did not start")

    def mend(self) -> DaskHere:
        """Start another worker for each that has ended, and return when all are there."""
        for number, worker in enumerate(self.workers):
            if worker.poll() is not None:
                self.workers[number] = self._start_worker(number)
        return self.wait()

    def stop(self) -> None:
        """End all of them."""
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()
        self._log.close()
