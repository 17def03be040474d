"""Background tasks: work of seconds runs on its own thread, beside messages and map."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

Result = TypeVar("Result")


def in_background(name: str, work: Callable[[], Result]) -> Future[Result]:
    """Begin work on a thread with a name; the end of the program does not wait for it.

    The threads of an executor would hold the end up: a server may take minutes to answer.
    """
    future: Future[Result] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:  # noqa: BLE001 - raised where the result is taken
            future.set_exception(error)

    Thread(target=run, daemon=True, name=name).start()
    return future
