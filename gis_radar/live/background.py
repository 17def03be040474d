"""Background tasks: what takes seconds runs on a thread of its own beside messages and map."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread
from typing import Generic, TypeVar

Answer = TypeVar("Answer")


class BackgroundTask(Generic[Answer]):
    """Runs one task at a time on a thread of its own.

    Parameters
    ----------
    name : str
        Of its thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: Thread | None = None
        self._answers: list[Answer] = []
        self._errors: list[BaseException] = []

    @property
    def busy(self) -> bool:
        """Whether a task is running or its answer was not taken yet."""
        return self._thread is not None

    def begin(self, work: Callable[[], Answer]) -> None:
        """Begin a task; none may be running."""

        def run() -> None:
            try:
                self._answers.append(work())
            except BaseException as error:  # noqa: BLE001 - raised by take, in the caller's thread
                self._errors.append(error)

        thread = Thread(target=run, daemon=True, name=self._name)
        thread.start()
        self._thread = thread  # only now: one that could not be started is none

    def take(self, *, wait: bool = False) -> Answer | None:
        """Return the answer once the task is done; raise what it raised.

        Parameters
        ----------
        wait : bool
            Whether to wait until the task is done.
        """
        if self._thread is None or (self._thread.is_alive() and not wait):
            return None
        self._thread.join()
        self._thread = None
        if self._errors:
            raise self._errors.pop()
        return self._answers.pop()
