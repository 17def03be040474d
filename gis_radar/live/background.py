"""Background tasks: work of seconds runs on its own thread, beside messages and map."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread
from typing import Generic, TypeVar

Answer = TypeVar("Answer")


class BackgroundTask(Generic[Answer]):
    """Runner of one task at a time on a thread of its own.

    Parameters
    ----------
    name : str
        Name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: Thread | None = None
        self._answers: list[Answer] = []
        self._errors: list[BaseException] = []

    @property
    def busy(self) -> bool:
        """Whether a task is running, or its answer was not taken yet."""
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
        self._thread = thread  # after start, which may fail

    def take(self, *, wait: bool = False) -> Answer | None:
        """Return the answer if the task is done, else None; raise the task's exception.

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
