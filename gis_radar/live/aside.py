"""Work aside: what takes seconds runs on a thread of its own, while messages and map go on."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread
from typing import Generic, TypeVar

Answer = TypeVar("Answer")


class Aside(Generic[Answer]):
    """One piece of work at a time.

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
        """Whether work is going on, or its answer was not taken yet."""
        return self._thread is not None

    def begin(self, work: Callable[[], Answer]) -> None:
        """Begin a piece of work; none may be going on."""

        def run() -> None:
            try:
                self._answers.append(work())
            except BaseException as error:  # noqa: BLE001 - raised by take, in the caller's thread
                self._errors.append(error)

        thread = Thread(target=run, daemon=True, name=self._name)
        thread.start()
        self._thread = thread  # only now: one that could not be started is none

    def take(self, *, wait: bool = False) -> Answer | None:
        """Return the answer once it is there; raise what the work raised.

        Parameters
        ----------
        wait : bool
            Whether to wait for the end of what is going on.
        """
        if self._thread is None or (self._thread.is_alive() and not wait):
            return None
        self._thread.join()
        self._thread = None
        if self._errors:
            raise self._errors.pop()
        return self._answers.pop()
