"""The base of all algorithms: the worker, its progress in QGIS, its errors as one sentence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from qgis.core import (
    QgsApplication,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsSettings,
)
from qgis.PyQt.QtGui import QIcon

from .loading import finish_output
from .opening import Opened, offer
from .parameters import Given, Output, OutputLayer, Parameter
from .runner import (
    Answer,
    CancelledError,
    Listener,
    NoWorkerError,
    WorkerError,
    run_worker,
)
from .words import speaks_german, tr
from .worker import find_python, plugin_version, same_series, worker_version

SETTING = "gis_radar/worker_python"
ICONS = Path(__file__).parent / "icons"
# Figures of hits, for diagnosis: beside occupancy a reader would take them for it.
_OF_HITS = {"hits", "tiles hit", "occupied s"}
ALL_STAGES = "all stages"  # as a site's run calls them
SITE, TRAFFIC, RESULTS, SET_UP = "Site", "Traffic", "Results", "Set-up"


def profile_folder() -> Path:
    """Return the folder of the user's QGIS profile."""
    return Path(QgsApplication.qgisSettingsDirPath())


def chosen_python() -> str:
    """Return the worker's Python; see :func:`worker.find_python`."""
    return find_python(str(QgsSettings().value(SETTING, "") or ""), profile_folder())


class WorkerFeedback(Listener):
    """The worker's progress and remarks as a QGIS feedback shows them."""

    def __init__(self, feedback: Any) -> None:
        self._feedback = feedback
        self._shares: dict[str, float] = {}  # of the stages begun, how much is done
        self._ended, self._stages = 0.0, 0.0  # of a site's run, once it reports them
        self._percent = 0.0

    def progress(self, stage: str, done: float, total: float | None) -> None:
        """Show the stage, and how far it is; of a site's run, how far all stages are."""
        if stage in (ALL_STAGES, tr(ALL_STAGES)):
            self._ended, self._stages = done, total or 0.0
        else:
            # Stages that run at once report in turns: each is named once.
            if stage not in self._shares:
                self._feedback.setProgressText(stage)
            self._shares[stage] = min(1.0, done / total) if total else 0.0
        if self._stages:
            begun = sum(share for share in self._shares.values() if share < 1.0)
            percent = 100.0 * min(1.0, (self._ended + begun) / self._stages)
            self._percent = max(self._percent, percent)
            self._feedback.setProgress(self._percent)
        elif total:
            self._feedback.setProgress(100.0 * self._shares[stage])

    def log(self, message: str, level: str) -> None:
        """Show a remark."""
        show = self._feedback.pushWarning if level == "warning" else self._feedback.pushInfo
        show(message)

    def cancelled(self) -> bool:
        """Return whether the user has pressed Cancel."""
        return bool(self._feedback.isCanceled())


@contextmanager
def one_sentence() -> Iterator[None]:
    """Turn what goes wrong with a worker into QGIS's own exception, in the user's language."""
    try:
        yield
    except CancelledError as error:
        raise QgsProcessingException(tr("Cancelled; nothing was left half-written.")) from error
    except WorkerError as error:
        raise QgsProcessingException(str(error)) from error


def make_folders(outputs: Sequence[str]) -> None:
    """Make the folders that outputs go into."""
    try:
        for each in outputs:
            Path(each).parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkerError(
            "{folder}: cannot be made: {reason}", folder=error.filename, reason=error.strerror
        ) from error


class Algorithm(QgsProcessingAlgorithm):  # type: ignore[misc]
    """An algorithm of the toolbox; children are described by class attributes."""

    NAME: ClassVar[str] = ""
    TITLE: ClassVar[str] = ""
    GROUP: ClassVar[str] = SITE
    HELP: ClassVar[str] = ""
    KEYWORDS: ClassVar[tuple[str, ...]] = ()
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = ()

    def __init__(self) -> None:
        super().__init__()
        self.made: list[Opened] = []  # to be opened by buttons at the end

    def postProcessAlgorithm(  # noqa: N802
        self, _context: QgsProcessingContext, _feedback: Any
    ) -> dict[str, Any]:
        """Show buttons that open the results: QGIS calls this in its own thread, at the end."""
        offer(self.NAME, self.made)
        return {}

    def createInstance(self) -> QgsProcessingAlgorithm:  # noqa: N802
        return type(self)()

    def name(self) -> str:
        return self.NAME

    def displayName(self) -> str:  # noqa: N802
        return tr(self.TITLE)

    def group(self) -> str:
        return tr(self.GROUP)

    def groupId(self) -> str:  # noqa: N802
        return self.GROUP.lower().replace("-", "")

    def tags(self) -> list[str]:
        return ["radar", "traffic", "lanelet", *self.KEYWORDS]

    def shortDescription(self) -> str:  # noqa: N802
        return tr(self.HELP).split("\n", maxsplit=1)[0]

    def shortHelpString(self) -> str:  # noqa: N802
        paragraphs = tr(self.HELP).replace(" %", "\u202f%").split("\n")
        return "".join(f"<p>{paragraph}</p>" for paragraph in paragraphs if paragraph)

    def icon(self) -> QIcon:
        return QIcon(self.svgIconPath())

    def svgIconPath(self) -> str:  # noqa: N802
        return str(ICONS / f"{self.NAME}.svg")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        for parameter in self.PARAMETERS:
            parameter.add_to(self)

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        return self.process(Given(self, parameters, context, feedback))

    def process(self, given: Given) -> dict[str, Any]:
        """Do the work; return the results by name."""
        raise NotImplementedError


class WorkerAlgorithm(Algorithm):
    """An algorithm that is a command of the worker: the words of its parameters, in their order."""

    COMMAND: ClassVar[str] = ""
    CHANGES: ClassVar[tuple[str, ...]] = ()  # parameters that are read and written

    def process(self, given: Given) -> dict[str, Any]:
        outputs = [each for each in self.PARAMETERS if isinstance(each, Output)]
        given.outputs.update({each.name: each.path(given) for each in outputs})
        words = [word for each in self.PARAMETERS for word in each.words(given)]
        written = [given.outputs[each.name] for each in outputs if each.flag is not None]
        written += [given.text(name) for name in self.CHANGES]
        answer = self.work(
            [self.COMMAND, *words], [path for path in written if path], given.feedback
        )
        results = given.outputs | self.finish(given, answer)
        for each in outputs:
            if isinstance(each, OutputLayer):
                finish_output(given.context, given.outputs[each.name])
        return results

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        """Do what follows the command, such as loading layers; return further results."""
        del given, answer
        return {}

    def canExecute(self) -> tuple[bool, str]:  # noqa: N802
        """Return whether there is a worker, and if not, what to do."""
        try:
            chosen_python()
        except WorkerError as error:
            return False, self._what_to_do(error)
        return True, ""

    @staticmethod
    def _what_to_do(error: WorkerError) -> str:
        if isinstance(error, NoWorkerError):
            return str(error)
        return f"{error}: " + tr("run 'Set up the worker' again.")

    def _python(self) -> str:
        """Return the worker's Python if it fits this plugin."""
        try:
            python = chosen_python()
            version = worker_version(python)
        except WorkerError as error:
            raise QgsProcessingException(self._what_to_do(error)) from error
        if not same_series(version, plugin_version()):
            raise QgsProcessingException(
                tr("The worker is gis_radar {worker}, the plugin {plugin}:").format(
                    worker=version, plugin=plugin_version()
                )
                + " "
                + tr("run 'Set up the worker' again.")
            )
        return python

    def work(self, words: Sequence[str], outputs: Sequence[str], feedback: Any) -> Answer:
        """Run a command in the worker, and show its figures.

        Parameters
        ----------
        words : sequence of str
            The command and its options.
        outputs : sequence of str
            The files and folders that it writes.
        feedback : QgsProcessingFeedback
            Shows progress and remarks, and may cancel.

        Raises
        ------
        QgsProcessingException
            In one sentence, if it is cancelled or fails.
        """
        python = self._python()
        with one_sentence():
            make_folders(outputs)
            answer = run_worker(python, words, WorkerFeedback(feedback))
        for line in summary_lines(answer.local or answer.summary):
            feedback.pushInfo(line)
        return answer


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return a line for each figure, and a line for the figures of each sensor.

    Beside occupancy, figures of hits are left out. Tracks are no count, and not called vehicles.
    """
    lines = []
    occupied = bool({"mean occupancy", "mean_occupancy", "passages"} & set(summary))
    for name, value in summary.items():
        title = as_title(name)
        if occupied and name.replace("_", " ") in _OF_HITS:
            continue
        if occupied and name == "vehicles":
            title = tr("Tracks of vehicles")
        if value and isinstance(value, dict) and all(isinstance(p, dict) for p in value.values()):
            lines += [f"{title}: {key}: {readable(part)}" for key, part in value.items()]
        else:
            lines.append(f"{title}: {readable(value)}")
    return lines


def as_title(name: str) -> str:
    """Return the name of a figure as people read it, as the terminal does."""
    error, sigma, of = name.rpartition("sigma_")
    return f"{sigma[:-1]} {as_title(of)}" if sigma and not error else tr(name.replace("_", " "))


def readable(value: Any) -> str:
    """Return a figure as a person would write it."""
    if value is None or value == {}:
        return tr("not known" if value is None else "none")
    if isinstance(value, dict):
        return ", ".join(f"{as_title(k)} {readable(v)}" for k, v in value.items())
    if isinstance(value, bool):
        return tr("yes") if value else tr("no")
    if isinstance(value, float):
        text = f"{value:.4g}" if abs(value) < 1000 else f"{value:.2f}"
        return text.replace(".", ",") if speaks_german() else text
    if isinstance(value, (list, tuple)):
        return ", ".join(readable(item) for item in value)
    return tr(str(value))
