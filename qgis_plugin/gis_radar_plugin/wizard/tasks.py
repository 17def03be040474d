"""Work beside the window: commands of the worker and whole runs as tasks of QGIS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from qgis.core import (
    QgsApplication,
    QgsProcessingAlgRunnerTask,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProject,
    QgsTask,
)
from qgis.PyQt.QtCore import pyqtSignal

from ..base import PROVIDER, chosen_python
from ..runner import Answer, CancelledError, Listener, WorkerError, run_worker
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
    """

    def __init__(
        self,
        title: str,
        words: Sequence[str],
        then: Callable[[Answer | str, list[str]], None],
    ) -> None:
        super().__init__(title, QgsTask.Flag.CanCancel)
        self._words = list(words)
        self._then = then
        self._answer: Answer | str = ""
        self._warnings: list[str] = []

    def run(self) -> bool:
        """Work; QGIS calls it in a thread of its own."""
        try:
            self._answer = run_worker(chosen_python(), self._words, _TaskListener(self))
        except CancelledError:
            self._answer = tr("Cancelled; nothing was left half-written.")
        except WorkerError as error:
            self._answer = str(error)
        return isinstance(self._answer, Answer)

    def finished(self, _done: bool) -> None:  # noqa: FBT001 - as QGIS calls it
        """Hand on the result; QGIS calls it in the window's thread."""
        self._then(self._answer, self._warnings)

    def warned(self, message: str) -> None:
        """Keep a warning."""
        self._warnings.append(message)


class _TaskListener(Listener):
    def __init__(self, task: WorkerTask) -> None:
        self._task = task

    def progress(self, stage: str, done: float, total: float | None) -> None:
        del stage
        if total:
            self._task.setProgress(100.0 * done / total)

    def log(self, message: str, level: str) -> None:
        if level == "warning":
            self._task.warned(message)

    def cancelled(self) -> bool:
        return bool(self._task.isCanceled())


class RunFeedback(QgsProcessingFeedback):  # type: ignore[misc]
    """What a run reports, as signals: it speaks from a thread of its own."""

    said = pyqtSignal(str, str)  # kind (`stage`, `info`, `warning`, `error`) and text

    def __init__(self) -> None:
        super().__init__(False)

    def setProgressText(self, text: str) -> None:  # noqa: N802
        self.said.emit("stage", text)

    def pushInfo(self, info: str) -> None:  # noqa: N802
        self.said.emit("info", info)

    def pushWarning(self, warning: str) -> None:  # noqa: N802
        self.said.emit("warning", warning)

    def reportError(self, error: str, fatalError: bool = False) -> None:  # noqa: N802, N803, FBT001, FBT002
        del fatalError
        self.said.emit("error", error)


_RUNNING: set[SiteRunner] = set()  # QGIS works with what they hold, also when the window is gone


class SiteRunner:
    """A run of a site file: the algorithm of the toolbox as a task, its layers loaded at the end.

    Parameters
    ----------
    site, folder : str
        The site file, and where the results go.
    feedback : RunFeedback
        Hears how far it is.
    then : callable
        Called with whether it is done, in the window's thread.
    """

    def __init__(
        self, site: str, folder: str, feedback: RunFeedback, then: Callable[[bool], None]
    ) -> None:
        self._feedback, self._then = feedback, then
        self._context = QgsProcessingContext()
        self._context.setProject(QgsProject.instance())
        registry = QgsApplication.processingRegistry()
        self._algorithm = registry.createAlgorithmById(f"{PROVIDER}:runsite")
        self._parameters = {"SITE": site, "OUTPUT": folder}
        self.task = QgsProcessingAlgRunnerTask(
            self._algorithm, self._parameters, self._context, feedback
        )
        self.task.executed.connect(self._executed)

    def start(self) -> None:
        """Begin."""
        _RUNNING.add(self)
        QgsApplication.taskManager().addTask(self.task)

    def cancel(self) -> None:
        """Stop; what is done stays done, and another run goes on from there."""
        self._feedback.cancel()
        self.task.cancel()

    def _executed(self, done: bool, _results: dict[str, Any]) -> None:  # noqa: FBT001
        _RUNNING.discard(self)
        if done:
            from processing.gui.Postprocessing import (  # noqa: PLC0415 - a plugin of QGIS
                handleAlgorithmResults,
            )

            handleAlgorithmResults(self._algorithm, self._context, self._feedback, {})
        self._then(done)
