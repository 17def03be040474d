"""Commands of the worker as tasks of QGIS, which run beside the window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from qgis.core import QgsApplication, QgsTask

from ..base import WorkerFeedback, chosen_python
from ..runner import Answer, CancelledError, WorkerError, run_worker
from ..words import tr


class WorkerTask(QgsTask):  # type: ignore[misc]
    """A command of gis_radar as a task of QGIS, with progress and cancel.

    Parameters
    ----------
    title : str
        As QGIS's list of tasks shows it.
    words : sequence of str
        The command and its options.
    then : callable
        Called in the window's thread with the answer, or with what went wrong in a sentence, and
        the warnings.

    Attributes
    ----------
    summary : dict
        What was found where something went wrong.
    """

    def __init__(
        self,
        title: str,
        words: Sequence[str],
        then: Callable[[Answer | str, list[str]], None],
    ) -> None:
        super().__init__(title, QgsTask.Flag.CanCancel)
        self._words = list(words)
        self._then: Callable[[Answer | str, list[str]], None] | None = then
        self._answer: Answer | str = ""
        self._warnings: list[str] = []
        self.summary: dict[str, Any] = {}

    @classmethod
    def start(
        cls,
        title: str,
        words: Sequence[str],
        then: Callable[[Answer | str, list[str]], None],
        moved: Callable[[float], None] | None = None,
    ) -> WorkerTask:
        """Start; `moved` is called with the progress, percent."""
        task = cls(title, words, then)
        if moved is not None:
            task.progressChanged.connect(lambda percent: task._then and moved(percent))
        QgsApplication.taskManager().addTask(task)
        return task

    def let_go(self) -> None:
        """Cancel, and ignore the answer."""
        self._then = None
        self.cancel()

    def run(self) -> bool:
        """Work; QGIS calls it in a thread of its own."""
        try:
            self._answer = run_worker(chosen_python(), self._words, WorkerFeedback(self))
        except CancelledError:
            self._answer = tr("Cancelled; nothing was left half-written.")
        except WorkerError as error:
            self._answer, self.summary = str(error), error.summary
        return isinstance(self._answer, Answer)

    def finished(self, _done: bool) -> None:  # noqa: FBT001 - as QGIS calls it
        """Hand on the result; QGIS calls it in the window's thread."""
        if self._then is not None:
            self._then(self._answer, self._warnings)

    def setProgressText(self, text: str) -> None:  # noqa: N802 - as a feedback of Processing
        """Leave the stage out: the list of tasks shows the title."""

    def pushInfo(self, text: str) -> None:  # noqa: N802
        """Leave a remark out."""

    def pushWarning(self, text: str) -> None:  # noqa: N802
        """Keep a warning."""
        self._warnings.append(text)
