"""Workers of a city's run: processes of this machine, or those of a Dask cluster.

Both are executors of :mod:`concurrent.futures`. Workers may be lost: what they had not finished is
given to others.
"""

from __future__ import annotations

import importlib
import logging
import signal
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    as_completed,
)
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from gis_radar.base import (
    GisRadarError,
    InputError,
    OutputError,
    Reporter,
    Text,
    UsageError,
    WorkerPool,
    first_line,
    go_offline,
    system_error,
    watch_parent,
    workers_here,
)
from gis_radar.site import WorkerContext, software

Key = TypeVar("Key", bound=Hashable)
Call = Sequence[Any]
"""A function of a module, and its arguments."""

_MOST_LOST = 3  # times in a row that workers are lost before a task is left out
_SCHEDULER_S = 600.0  # wait for a scheduler that is restarted, seconds
_TRY_S = 5.0  # time limit of one attempt to reach it, seconds
SAME = Text("install the same packages for all workers: results depend on them")
_FEWER = Text("if memory ran out, use fewer at once: --jobs 1")
_MEMORY = Text("memory may have run out")
_INSTALL = Text("install it: pip install gis-radar[city]")

_EQUAL = Text("install the same packages for scheduler and workers: results depend on them")

LOST = (BrokenExecutor, CancelledError, OSError, RuntimeError)
"""Errors of an executor whose workers or scheduler are gone; those of tasks are never these."""

_one_at_a_time = threading.Lock()  # for tasks: a worker of a cluster may have several threads


class OtherSoftwareError(InputError):
    """A worker has other packages than the run: its results would be others."""


class Workers(ABC):
    """Workers that carry out tasks; lost ones are replaced.

    Parameters
    ----------
    reporter : Reporter
        Receives a warning when workers are lost.
    """

    count: int = 1  # tasks at once

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self._executor: Executor | None = None

    def share(self, tasks: int) -> int:  # noqa: ARG002 - of `Processes`
        """Return how many processes each of some tasks may use."""
        return 1

    @abstractmethod
    def begin(self) -> Executor:
        """Return a new executor."""

    @abstractmethod
    def end(self, executor: Executor) -> None:
        """Stop an executor at once, with what it is doing."""

    def close(self, *, at_once: bool) -> None:
        """Stop the workers, at once or after their tasks."""
        if self._executor is not None and at_once:
            self.end(self._executor)
        elif self._executor is not None:
            self._executor.shutdown()
        self._executor = None

    def results(self, calls: Mapping[Key, Call]) -> Iterator[tuple[Key, Any]]:
        """Carry out tasks, the first ones first, and yield each result or error as it comes.

        Parameters
        ----------
        calls : mapping
            The tasks by key.

        Yields
        ------
        (key, result)
            The result is a :class:`GisRadarError` where there is none.

        Raises
        ------
        OtherSoftwareError
            If a worker has other packages.
        OutputError
            If workers are lost again and again, whatever they do.
        """
        pending, lost = dict(calls), 0
        while pending:
            if self._executor is None:
                self._executor = self.begin()
            before, alone = len(pending), lost >= _MOST_LOST - 1
            attempted = list(pending)[: 1 if alone else None]
            try:
                running = {
                    self._executor.submit(run_task, software(), *pending[key]): key
                    for key in attempted
                }
                for future in as_completed(running):
                    result, key = _result(future), running[future]
                    del pending[key]
                    yield key, result
                lost = 0
            except LOST as error:
                lost = 1 if len(pending) < before else lost + 1
                self._replace(lost, error)
                if alone:  # it was the only task at work
                    del pending[attempted[0]]
                    yield attempted[0], GisRadarError("its workers were lost", hint=_MEMORY)
                for key in list(pending)[: self.count]:  # those that may have ended workers go last
                    pending[key] = pending.pop(key)

    def _replace(self, times: int, error: Exception) -> None:
        """Stop lost workers, so that new ones begin; give up where all are lost."""
        with suppress(Exception):
            self.close(at_once=True)
        self._executor = None
        if times >= _MOST_LOST + self.count:
            raise OutputError("workers were lost {} times in a row", times, hint=_FEWER) from error
        self._reporter.warn("workers were lost: what they had not finished is done again")


def _result(future: Future[Any]) -> Any:
    """Return the result of a task, or the error for which it has none."""
    try:
        return future.result()
    except (OtherSoftwareError, ImportError, *LOST) as error:
        for each in (error, error.__cause__):  # in a task an ImportError is a fault of gis_radar
            if isinstance(each, ImportError):
                raise OtherSoftwareError(
                    "the scheduler or a worker lacks a package of the run: {}", each, hint=_EQUAL
                ) from error
        raise
    except GisRadarError as error:
        return error
    except Exception as error:  # noqa: BLE001 - Dask's KilledWorker: several ended at this task
        return GisRadarError("its workers were lost: {}", first_line(error), hint=_MEMORY)


def run_task(expected: Mapping[str, str], work: Callable[..., Any], *arguments: Any) -> Any:
    """Carry out a task in a worker.

    Parameters
    ----------
    expected : mapping
        The software of the run, from :func:`gis_radar.site.software`.
    work : callable
        A function of a module.
    *arguments
        Its arguments.

    Raises
    ------
    OtherSoftwareError
        If the worker has another software.
    GisRadarError
        If there is no result; a fault in gis_radar is one, too, with its place.
    """
    if differs := [name for name, found in software().items() if expected.get(name) != found]:
        name = differs[0]
        if name == "code":
            raise OtherSoftwareError("a worker has another gis_radar than the run", hint=SAME)
        raise OtherSoftwareError(
            "a worker has {} {}, the run {}", name, software()[name], expected.get(name, ""),
            hint=_EQUAL,
        )  # fmt: skip
    go_offline()
    with _one_at_a_time:
        try:
            return work(*arguments)
        except GisRadarError:
            raise
        except OSError as error:
            raise system_error(error) from error
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            raise GisRadarError(
                "fault in gis_radar, {}:{}: {}", Path(place.filename).name, place.lineno,
                f"{error!r:.200}",
            ) from error  # fmt: skip


class Processes(Workers):
    """Worker processes of this machine.

    Parameters
    ----------
    jobs : int, optional
        Number of processes; by default as many as the machine has cores and memory for.
    reporter : Reporter
        As for :class:`Workers`.
    """

    def __init__(self, jobs: int | None, reporter: Reporter) -> None:
        super().__init__(reporter)
        self.count = jobs or workers_here()

    def share(self, tasks: int) -> int:
        """Return how many processes each of some tasks may use."""
        return max(self.count // max(tasks, 1), 1)

    def begin(self) -> Executor:
        """Return a pool of new processes: copies of this one would inherit locks of libraries."""
        return WorkerPool(self.count, context=WorkerContext(), initializer=_prepare_worker)

    def end(self, executor: Executor) -> None:
        """Stop the pool at once."""
        if isinstance(executor, WorkerPool):
            executor.stop()


def _prepare_worker() -> None:
    """Prepare a worker process: it ends with the run, and SIGTERM ends it without a word."""
    watch_parent()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


class Cluster(Workers):
    """Workers of a Dask cluster.

    Parameters
    ----------
    address : str
        Address of its scheduler, such as `tcp://10.0.0.5:8786`.
    reporter : Reporter
        As for :class:`Workers`; it also receives the address of Dask's dashboard.

    Raises
    ------
    UsageError
        If Dask is not installed, or the address is none.
    OutputError
        If no scheduler answers.
    """

    def __init__(self, address: str, reporter: Reporter) -> None:
        super().__init__(reporter)
        try:
            self._dask: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise UsageError("a cluster needs the package distributed", hint=_INSTALL) from error
        for name in _loggers_of_dask():  # they print tracebacks
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:  # before there is a client, which Dask could not close
            importlib.import_module("distributed.comm").get_address_host_port(address)
        except ValueError as error:
            raise UsageError(
                "{}: is no address of a scheduler: {}", address, error,
                hint="such as tcp://10.0.0.5:8786",
            ) from error  # fmt: skip
        self._address = address
        self._client: Any = None
        self._executor = self._connected(_TRY_S)
        self._describe()

    def _describe(self) -> None:
        """Report where the dashboard is, and warn of missing workers and of several threads."""
        address, reporter = self._address, self._reporter
        known = self._client.scheduler_info(n_workers=-1)["workers"].values()
        self.count = max(sum(each["nthreads"] for each in known), 1)
        reporter.log(Text("Dask's dashboard: {}", self._client.dashboard_link))
        if not known:
            reporter.warn(
                "{} has no worker yet: start one by dask worker {} --nthreads 1", address, address
            )
        elif any(each["nthreads"] > 1 for each in known):
            reporter.warn("workers do one task at once: start them with --nthreads 1")

    def begin(self) -> Executor:
        """Return an executor of the cluster; wait for a scheduler that is restarted."""
        return self._connected(_SCHEDULER_S)

    def end(self, executor: Executor) -> None:
        """Leave the cluster; its workers drop the tasks of this run."""
        executor.shutdown(wait=False)
        if self._client is not None:
            self._client.close(timeout=_TRY_S)

    def _connected(self, patience_s: float) -> Executor:
        end = time.monotonic() + patience_s
        while True:
            try:
                self._client = self._dask.Client(
                    self._address, timeout=_TRY_S, set_as_default=False
                )
                executor: Executor = self._client.get_executor(pure=False)
            except OSError as error:
                if time.monotonic() > end:
                    raise OutputError(
                        "{}: no scheduler answers", self._address,
                        hint="start it by dask scheduler, or leave --executor out",
                    ) from error  # fmt: skip
                time.sleep(1.0)
            else:
                return executor


def _loggers_of_dask() -> list[str]:
    """Return the names of Dask's loggers: its settings give some a level of their own."""
    known = (name for name in logging.root.manager.loggerDict if name.startswith("distributed."))
    return ["distributed", *known]


@contextmanager
def workers_of(address: str | None, jobs: int | None, reporter: Reporter) -> Iterator[Workers]:
    """Provide the workers of a run; they are stopped at the end of the block.

    Parameters
    ----------
    address : str, optional
        Address of a Dask scheduler; without one, processes of this machine work.
    jobs : int, optional
        Number of processes.
    reporter : Reporter
        Receives remarks on the workers.

    Raises
    ------
    UsageError
        If both are given, or `jobs` is less than 1.
    """
    if address is not None and jobs is not None:
        raise UsageError("{} and {} are given: a cluster knows its workers", "--executor", "--jobs")
    if jobs is not None and jobs < 1:
        raise UsageError("jobs is {}, expected 1 or more", jobs)
    workers = Processes(jobs, reporter) if address is None else Cluster(address, reporter)
    try:
        yield workers
    except BaseException:
        workers.close(at_once=True)
        raise
    workers.close(at_once=False)
