"""Engines of ``hood dress``: processes here, tasks of Ray, jobs of SLURM, or processes of torchrun, which take rows by turns.

Ray and submitit are packages of their own, imported where they are asked for.
"""

from __future__ import annotations

import _thread
import importlib
import importlib.util
import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import ModuleType
from typing import Any

from omegaconf import DictConfig

from hood.app.batch.manifest import Manifest
from hood.app.batch.rows import DataRow
from hood.app.batch.work import Call, HopelessError, is_held, lose, make_row, pull
from hood.app.settings.compose import ConfigError, plain, require_choice, shown
from hood.assets.files.said import install, say

_ENGINES = LOCAL, RAY, SLURM, TORCHRUN = "local", "ray", "slurm", "torchrun"
#: Packages that engines need, and the extra of each.
_PACKAGES = {RAY: "ray", SLURM: "submitit"}
#: Seconds between two looks at the manifest.
_PAUSE = 0.2
#: Processes that end before they make a row, one after the other, until nothing is expected of further ones.
_VAIN = 5
#: Seconds between two looks whether Ray's cluster is there.
_SIGN = 3.0
_REFUSED = "engine=slurm: the cluster refuses the jobs"

#: Is called now and then while others work: reads what they have done, and says it.
Follow = Callable[[], None]


def check_engine(config: DictConfig) -> None:
    """Raise ConfigError where the keys of an engine cannot be meant, or its package is not installed."""
    require_choice(config, "engine", _ENGINES)
    engine, workers = str(config.engine), config.workers
    if workers is not None and (isinstance(workers, bool) or not isinstance(workers, int) or workers < 1):
        raise ConfigError(f"workers={shown(workers)}: give a whole number from 1 on, or null")
    package = _PACKAGES.get(engine)
    if package is not None and importlib.util.find_spec(package) is None:
        raise ConfigError(f"engine={engine} needs the package {package}: {install(engine)}")
    started = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if started and engine != TORCHRUN:
        raise ConfigError(f"engine={engine}: torchrun started this process; add engine=torchrun")
    if engine == TORCHRUN and "RANK" not in os.environ:
        raise ConfigError(
            "engine=torchrun: torchrun did not start this process; begin the command with torchrun, or leave it out"
        )
    if engine == TORCHRUN and workers is not None:
        raise ConfigError(f"workers={workers}: torchrun says how many there are, --nproc-per-node={workers}; leave it out")
    if engine == SLURM and workers is None:
        raise ConfigError("engine=slurm: workers=… says how many jobs the array has; give it")
    if config.cluster is not None and (
        engine not in _PACKAGES or (engine == SLURM and config.cluster not in ("slurm", "local"))
    ):
        raise ConfigError(
            f"cluster={config.cluster}: is of engine=ray an address, of engine=slurm slurm or local; leave it out"
        )
    if config.job is not None and (engine != SLURM or not isinstance(plain(config.job), dict)):
        raise ConfigError(f"job={shown(config.job)}: is a table for engine=slurm, such as job={{timeout_min:600}}")


def tells_user() -> bool:
    """Whether this process tells the user how far the work is."""
    return int(os.environ.get("RANK", "0")) == 0


def run_engine(config: DictConfig, call: Call, rows: Sequence[DataRow], follow: Follow) -> None:
    """Make the rows, or those that nobody else makes; ``follow`` is called meanwhile.

    Raises:
        OSError: the disk refuses; an engine that cannot work.
        ConfigError: an engine that cannot begin.
    """
    engine = str(config.engine)
    workers = workers_of(config)
    if engine == LOCAL:
        Pool(call, rows, min(workers, len(rows))).work(follow)
    elif engine == TORCHRUN:
        rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        Pool(call, rows, 1, first=rank * len(rows) // size).work(follow, stay=rank == 0)
    elif engine == RAY:
        _run_ray(config, call, rows, follow)
    else:
        _run_slurm(config, call, rows, min(workers, len(rows)), follow)


def workers_of(config: DictConfig) -> int:
    """How many processes work at once: as many as asked for, else one for each processor that this process may use."""
    if config.workers is not None:
        return int(config.workers)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# ---- processes here --------------------------------------------------------------------------------------------------


class Pool:
    """Processes that take rows until none is left; one that is killed is replaced.

    Args:
        workers: how many.
        first: place of the row that the first of them begins with; the others begin in even distances.
    """

    def __init__(self, call: Call, rows: Sequence[DataRow], workers: int, first: int = 0) -> None:
        self.call, self.rows, self.left = call, rows, {row.name for row in rows}
        self._firsts = [first + place * len(rows) // workers for place in range(workers)]
        self._running: dict[int, tuple[SpawnProcess, Connection]] = {}
        self._manifest, self._vain = Manifest(call.folder, call.since), 0

    def work(self, follow: Follow, stay: bool = True) -> None:
        """Until all rows are done; without ``stay`` until others hold what is left.

        Raises:
            OSError: the disk refuses.
            ChildProcessError: processes end before they make a row.
        """
        try:
            while self._look():
                follow()
                self._fill()
                if not self._running and not stay:
                    break
                wait([process.sentinel for process, _ in self._running.values()], _PAUSE)
                if not self._running:
                    time.sleep(_PAUSE)
                self._reap()
            follow()
        finally:
            for process, _ in self._running.values():
                process.terminate()
            for process, _ in self._running.values():
                process.join()

    def _look(self) -> bool:
        """Whether rows are left."""
        done = {line["row"] for line in self._manifest.new()}
        if done & self.left:
            self._vain = 0
        self.left -= done
        return bool(self.left)

    def _fill(self) -> None:
        """Start processes where there are too few and rows that nobody holds."""
        missing = [place for place in range(len(self._firsts)) if place not in self._running]
        if not missing:
            return
        free = sum(row.name in self.left and not is_held(self.call.folder, row) for row in self.rows)
        for place in missing[:free]:
            self._running[place] = self._start(self._firsts[place])

    def _start(self, first: int) -> tuple[SpawnProcess, Connection]:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe(duplex=False)
        before, caller = os.environ.get("OMP_NUM_THREADS"), sys.modules["__main__"]
        os.environ["OMP_NUM_THREADS"] = "1"  # read when torch is loaded
        sys.modules["__main__"] = ModuleType("__main__")  # the process does not run a caller's script again
        try:
            process = context.Process(target=_worker, args=(self.call, self.rows, first, there), daemon=True)
            process.start()
        finally:
            sys.modules["__main__"] = caller
            os.environ.pop("OMP_NUM_THREADS")
            if before is not None:
                os.environ["OMP_NUM_THREADS"] = before
        there.close()
        return process, here

    def _reap(self) -> None:
        for place, (process, connection) in list(self._running.items()):
            if process.is_alive():
                continue
            process.join()
            del self._running[place]
            error: OSError | None = None
            with suppress(EOFError, OSError):
                error = connection.recv() if connection.poll() else None
            connection.close()
            if error is not None:
                raise error
            if process.exitcode:
                self._vain += 1
                if self._vain >= _VAIN + self.call.attempts * len(self._firsts):
                    raise ChildProcessError(
                        f"{self._vain} processes have ended before they made a row (exit code {process.exitcode})"
                    )


def _worker(call: Call, rows: Sequence[DataRow], first: int, connection: Connection) -> None:
    """A process of a pool; it ends with the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who started it is interrupted, and ends it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        pull(call, rows, first)
    except HopelessError as hopeless:
        cause = hopeless.__cause__
        assert isinstance(cause, OSError)
        connection.send(OSError(cause.errno, cause.strerror, cause.filename))
        os._exit(0)  # HDF5 would try to write what is open, and print that it cannot


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


# ---- Ray -------------------------------------------------------------------------------------------------------------


def _run_ray(config: DictConfig, call: Call, rows: Sequence[DataRow], follow: Follow) -> None:
    """A call a row; Ray begins it again on another process or machine where its own is lost."""
    ray = importlib.import_module("ray")
    quiet = {"log_to_driver": False, "include_dashboard": False, "logging_level": "ERROR"}
    given = {"address": str(config.cluster), "log_to_driver": False} if config.cluster is not None else quiet
    if config.cluster is None:
        given |= {"num_cpus": workers_of(config)}
    try:
        ray.init(**given)
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        raise ConfigError(f"engine=ray cluster={config.cluster}: {' '.join(str(error).split())}") from error
    lost = threading.Event()
    threading.Thread(target=_watch_ray, args=(str(ray.get_runtime_context().gcs_address), lost), daemon=True).start()
    try:
        _spread_ray(ray, config, call, rows, follow)
    except (KeyboardInterrupt, ray.exceptions.RayError) as error:
        if isinstance(error, KeyboardInterrupt) and not lost.is_set():
            ray.shutdown()
            raise
        raise ConnectionError("engine=ray: the cluster was lost; the same command goes on where it stopped") from error
    ray.shutdown()


def _spread_ray(ray: Any, config: DictConfig, call: Call, rows: Sequence[DataRow], follow: Follow) -> None:
    """Hand rows to Ray, a few more than are made at once."""
    remote = ray.remote(num_cpus=1, max_retries=call.attempts - 1)(_ray_row)
    known, waiting, running = ray.put(call), list(reversed(rows)), dict[Any, DataRow]()
    most = 2 * (int(config.workers) if config.workers is not None else int(ray.cluster_resources().get("CPU", 1)))
    while waiting or running:
        while waiting and len(running) < most:
            row = waiting.pop()
            running[remote.remote(known, row)] = row
        done, _ = ray.wait(list(running), num_returns=1, timeout=1.0)
        for reference in done:
            _finish_ray(ray, reference, call, running.pop(reference))
        follow()


def _watch_ray(address: str, lost: threading.Event) -> None:
    """Interrupt the main thread where nobody answers for the cluster any more: Ray itself waits for a minute, and then ends
    this process."""
    host, _, port = address.rpartition(":")
    missed = 0
    while missed < 3:
        time.sleep(_SIGN)
        try:
            socket.create_connection((host, int(port)), timeout=_SIGN).close()
            missed = 0
        except OSError:
            missed += 1
    lost.set()
    _thread.interrupt_main()


def _ray_row(call: Call, row: DataRow) -> tuple[int | None, str | None, str | None] | None:
    """A row, in a process of Ray; what the disk says where it refuses."""
    try:
        make_row(call, row, claimed=False)
    except HopelessError as hopeless:
        cause = hopeless.__cause__
        assert isinstance(cause, OSError)
        return cause.errno, cause.strerror, cause.filename
    return None


def _finish_ray(ray: Any, reference: Any, call: Call, row: DataRow) -> None:
    """Look how a call ended; a row whose processes were killed too often has failed."""
    try:
        refused = ray.get(reference)
    except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError, ray.exceptions.NodeDiedError) as error:
        lose(call, row, f"the process that made it was killed {call.attempts} times ({type(error).__name__})")
        return
    if refused is not None:
        raise OSError(*refused)


# ---- SLURM -----------------------------------------------------------------------------------------------------------


class _Job:
    """What a job of an array does: rows, until none is left. SLURM may end it; submitit then sends it in again."""

    def __init__(self, call: Call, rows: Sequence[DataRow], first: int) -> None:
        self.call, self.rows, self.first = call, rows, first

    def __call__(self) -> tuple[int | None, str | None, str | None] | None:
        try:
            Pool(self.call, self.rows, 1, self.first).work(lambda: None, stay=False)
        except OSError as error:
            return error.errno, error.strerror, error.filename
        return None

    def checkpoint(self) -> Any:
        """The job to send in, as submitit asks for it."""
        return importlib.import_module("submitit").helpers.DelayedSubmission(self)


def _run_slurm(config: DictConfig, call: Call, rows: Sequence[DataRow], workers: int, follow: Follow) -> None:
    submitit = importlib.import_module("submitit")
    logs = Path(call.folder) / "slurm"
    cluster = str(config.cluster or SLURM)  # submitit would take processes here where it finds no SLURM
    asked = {"name": "hood-dress", "cpus_per_task": 1, "timeout_min": 24 * 60} | dict(plain(config.job) or {})
    try:
        executor = submitit.AutoExecutor(folder=str(logs), cluster=cluster)
        executor.update_parameters(**asked)
        jobs = executor.map_array(
            lambda job: job(), [_Job(call, rows, place * len(rows) // workers) for place in range(workers)]
        )
    except Exception as error:  # of submitit, whose classes do not tell much
        raise ConfigError(f"{_REFUSED}: {' '.join(str(error).split())}") from error
    say(f"{len(jobs)} jobs, {jobs[0].job_id} and on; their logs are in {logs}")
    manifest, left = Manifest(call.folder, call.since), {row.name for row in rows}
    try:
        while left and not all(job.done() for job in jobs):
            time.sleep(_PAUSE if cluster == "local" else 5.0)
            follow()
            left -= {line["row"] for line in manifest.new()}
    except KeyboardInterrupt:
        for job in jobs:
            job.cancel(check=False)
        raise
    follow()
    for job in jobs:
        refused = None
        with suppress(Exception):  # a job that was killed; its rows are left for the next call
            refused = job.result() if job.done() else None
        if refused is not None:
            raise OSError(*refused)
