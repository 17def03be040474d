"""Pools of worker processes, which can be stopped at once with all that they started."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import contextmanager
from copy import copy
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from typing import Any

from gis_radar.base.errors import OutputError
from gis_radar.base.processes import stop_workers


class WorkerPool(ProcessPoolExecutor):
    """Executor of worker processes that keeps them, so that all can be stopped at once.

    Parameters
    ----------
    workers : int
        Most at once.
    context : multiprocessing.context.BaseContext, optional
        How they are started; by default as the system does.
    initializer : callable, optional
        Called in each with `given`. It, or the first task, calls
        :func:`~gis_radar.base.watch_parent`.
    given : tuple
        Its arguments.
    """

    def __init__(
        self, workers: int, *, context: BaseContext | None = None,
        initializer: Callable[..., object] | None = None, given: tuple[Any, ...] = (),
    ) -> None:  # fmt: skip
        self._kept: list[BaseProcess] = []
        keeping: Any = copy(context or multiprocessing.get_context())
        make = keeping.Process

        def keep(*words: Any, **options: Any) -> BaseProcess:
            self._kept.append(make(*words, **options))
            return self._kept[-1]

        keeping.Process = keep
        super().__init__(workers, mp_context=keeping, initializer=initializer, initargs=given)

    def stop(self) -> None:
        """Stop the workers at once, without waiting for their tasks."""
        self.shutdown(wait=False, cancel_futures=True)
        stop_workers(each for each in self._kept if each.pid is not None)


@contextmanager
def worker_pool(
    workers: int, initializer: Callable[..., None], *given: object
) -> Iterator[WorkerPool]:
    """Run worker processes, which stop at once where the block fails.

    Parameters
    ----------
    workers : int
        Most at once.
    initializer : callable
        Called in each with `given`; it calls :func:`~gis_radar.base.watch_parent`.
    *given
        Its arguments.

    Raises
    ------
    OutputError
        If a worker was killed.
    """
    with WorkerPool(workers, initializer=initializer, given=given) as pool:
        try:
            yield pool
        except BrokenExecutor as error:
            pool.stop()
            raise OutputError(
                "a worker process was killed",
                hint="if memory ran out, free some; where there is --jobs, use fewer at once",
            ) from error
        except BaseException:
            pool.stop()
            raise
