"""The last pages of the site wizard: check and save the site file, run it."""

from __future__ import annotations

import html
import time
from pathlib import Path
from typing import Any

from qgis.core import QgsApplication
from qgis.gui import QgsFileWidget
from qgis.PyQt.QtCore import QDateTime, Qt, QTimeZone, QUrl
from qgis.PyQt.QtGui import QDesktopServices
from qgis.PyQt.QtWidgets import (
    QFormLayout,
    QHBoxLayout,
    QLabel,
    QPlainTextEdit,
    QProgressBar,
    QPushButton,
    QTextBrowser,
    QVBoxLayout,
)

from ..report.pages import local_time
from ..runner import Answer
from ..words import speaks_german, tr
from .draft import keep_earlier
from .page import Page
from .tasks import RunFeedback, SiteRunner, WorkerTask

BAD, ODD, GOOD = "#b91c1c", "#b45309", "#15803d"


class CheckPage(Page):
    """Where the site file goes; it is written, and checked by gis_radar itself."""

    TITLE = "Check and save"
    SUBTITLE = (
        "The site file is written and checked: whether map, scan and recordings fit together."
    )

    def __init__(self) -> None:
        super().__init__()
        form = QFormLayout(self)
        self.site_box = QgsFileWidget()
        self.site_box.setStorageMode(QgsFileWidget.StorageMode.SaveFile)
        self.site_box.setFilter(tr("Site files") + " (*.toml)")
        self.site_box.setConfirmOverwrite(False)  # an earlier file is kept beside it
        self.site_box.fileChanged.connect(self._stale)
        form.addRow(tr("Site file"), self.site_box)
        self.folder_box = QgsFileWidget()
        self.folder_box.setStorageMode(QgsFileWidget.StorageMode.GetDirectory)
        form.addRow(tr("Folder of the results"), self.folder_box)
        self.folder_box.fileChanged.connect(lambda _: self.completeChanged.emit())
        self.check_button = QPushButton(tr("Save and check"))
        self.check_button.clicked.connect(self.check)
        self.bar = QProgressBar()
        row = QHBoxLayout()
        row.addWidget(self.check_button)
        row.addWidget(self.bar, 1)
        form.addRow("", row)
        self.found = QTextBrowser()
        self.found.setMinimumHeight(130)
        form.addRow(tr("Found"), self.found)
        self.text = QPlainTextEdit()
        self.text.setReadOnly(True)
        form.addRow(tr("The site file"), self.text)
        self.is_good = False
        self._task: WorkerTask | None = None
        self._number = 0  # of the check: what an earlier one answers counts for nothing

    def initializePage(self) -> None:  # noqa: N802
        """Propose where the files go, and check at once."""
        if not self.site_box.filePath():
            folder = Path(self.draft.map_file).parent
            self.site_box.setFilePath(str(folder / "SITE.toml"))
            self.folder_box.setFilePath(str(folder / "results"))
        self.bar.setVisible(False)
        self.found.clear()
        self._show_text()
        self.check()

    def _show_text(self) -> None:
        self.text.setPlainText(self.draft.text(Path(self.site_box.filePath()).parent))

    def _stale(self, _path: str) -> None:
        self.let_go()
        self._show_text()

    def cleanupPage(self) -> None:  # noqa: N802
        """Let the check go on the way back; QGIS calls it."""
        self.let_go()

    def let_go(self) -> None:
        """Stop a check that runs: what it answers counts for nothing."""
        if self._task is not None:
            self._task.cancel()
        self._task = None
        self._number += 1
        self.is_good = False
        self.check_button.setEnabled(True)
        self.bar.setVisible(False)
        self.completeChanged.emit()

    def check(self) -> None:
        """Write the site file and check it in the worker."""
        self.let_go()
        if not self._save():
            return
        self.check_button.setEnabled(False)
        self.bar.setVisible(True)
        self.bar.setValue(0)
        words, number = ["check", self.site_box.filePath()], self._number
        self._task = WorkerTask(
            tr("Check of the site"), words, lambda *answer: self._checked(number, *answer)
        )
        self._task.progressChanged.connect(lambda percent: self._progressed(number, percent))
        QgsApplication.taskManager().addTask(self._task)

    def _save(self) -> bool:
        """Write the site file; one that says something else is kept beside it."""
        path = Path(self.site_box.filePath())
        draft = self.draft
        if draft.read and path.parent != Path(draft.folder):
            line = tr("A site that was opened stays in {folder}: it names its files from there.")
            self.say(line.format(folder=draft.folder), BAD)
            return False
        text = draft.text(path.parent)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            own = self.wizard().written.get(str(path))
            if own is None or not path.is_file() or path.read_text(encoding="utf-8") != own:
                kept = keep_earlier(path, text)
                if kept is not None:
                    line = tr("{file} was there already: it is now {kept}.")
                    self.say(line.format(file=path.name, kept=kept.name), ODD)
                    if draft.read:
                        line = tr("Comments are in {kept} only; all its other keys are kept.")
                        self.say(line.format(kept=kept.name), ODD)
            path.write_text(text, encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            self.say(f"{path}: {tr('cannot be written')}: {reason}", BAD)
            return False
        self.wizard().written[str(path)] = text
        self._show_text()
        return True

    def _progressed(self, number: int, percent: float) -> None:
        if number == self._number:
            self.bar.setValue(int(percent))

    def _checked(self, number: int, answer: Answer | str, warnings: list[str]) -> None:
        if number != self._number:
            return  # something was changed since, or the window is closed
        self._task = None
        self.check_button.setEnabled(True)
        self.bar.setVisible(False)
        if isinstance(answer, str):
            self.say(answer, BAD)
            return
        figures = answer.summary.get("sensors", {})
        changed = False
        for sensor in self.draft.sensors:
            found = figures.get(sensor.name, {})
            measured = {key: value for key, value in found.items() if key.endswith(("_deg", "_m"))}
            changed |= not sensor.view and measured != sensor.measured
            sensor.measured = measured
            self.say(f"<b>{html.escape(sensor.name)}</b>: {self._recorded(found)}", "")
        if changed:
            self._save()
        for line in warnings:
            self.say(line, ODD)
        self.say(tr("The site can be run."), GOOD)
        self.is_good = True
        self.completeChanged.emit()

    def _recorded(self, found: dict[str, Any]) -> str:
        """Return what a sensor recorded in words, in the time of the site."""
        if "begin" not in found:
            return tr("its files are converted by the run")
        zone = QTimeZone(self.draft.timezone.encode())
        begin, end = (
            QDateTime.fromString(found[key], Qt.DateFormat.ISODateWithMs)
            for key in ("begin", "end")
        )
        count = f"{found['detections']:,}"
        text = tr("{time}; {count} detections; sees {azimuth} degrees wide, {range} m far").format(
            time=local_time(begin, end, zone),
            count=count.replace(",", ".") if speaks_german() else count,
            azimuth=f"{found.get('azimuth_deg', 0):.0f}",
            range=f"{found.get('max_range_m', 0):.0f}",
        )
        return html.escape(text)

    def say(self, text: str, colour: str) -> None:
        """Add a line to what was found; one with a colour is plain text."""
        if colour:
            text = f'<span style="color: {colour}">{html.escape(text)}</span>'
        self.found.append(text)

    def isComplete(self) -> bool:  # noqa: N802
        """Return whether the check is passed."""
        return self.is_good and bool(self.folder_box.filePath())


class RunPage(Page):
    """The run, as a task of QGIS: its progress, what it reports, and what to open at its end."""

    TITLE = "Run"
    SUBTITLE = (
        "Poses, tiles, vehicles and maps are made. You can go on working in QGIS; what is done "
        "stays done when you cancel, and another run goes on from there."
    )

    def __init__(self) -> None:
        super().__init__()
        column = QVBoxLayout(self)
        self.stage = QLabel()
        column.addWidget(self.stage)
        row = QHBoxLayout()
        self.bar = QProgressBar()
        self.run_button = QPushButton(tr("Run now"))
        self.run_button.clicked.connect(self.run)
        self.cancel_button = QPushButton(tr("Cancel the run"))
        self.cancel_button.clicked.connect(self.cancel)
        for part in (self.bar, self.run_button, self.cancel_button):
            row.addWidget(part)
        column.addLayout(row)
        self.log = QTextBrowser()
        column.addWidget(self.log, 1)
        row = QHBoxLayout()
        self.open_buttons = {}
        for name, text in (
            ("site.qgz", tr("Open the project")), ("report.html", tr("Open the report")),
            ("heatmap", tr("Make sheets...")), ("", tr("Show the folder")),
        ):  # fmt: skip
            button = QPushButton(text)
            button.clicked.connect(lambda _=False, file=name: self._open(file))
            self.open_buttons[name] = button
            row.addWidget(button)
        column.addLayout(row)
        self._runner: SiteRunner | None = None
        self._began = 0.0
        self._is_closed = False

    @property
    def folder(self) -> Path:
        """Where the results go."""
        return Path(self.wizard().check_page.folder_box.filePath())

    def initializePage(self) -> None:  # noqa: N802
        """Wait for the button: a run takes minutes."""
        self.log.clear()
        self.bar.setValue(0)
        self.stage.setText(tr("Results: {folder}").format(folder=self.folder))
        self._show_buttons(running=False)

    def run(self) -> None:
        """Begin the run."""
        if self._runner is not None:
            return
        self.log.clear()
        feedback = RunFeedback()
        feedback.said.connect(self._heard)
        feedback.progressChanged.connect(self._progressed)
        site = self.wizard().check_page.site_box.filePath()
        self._began = time.time()
        self.wizard().lanes.remove()  # the result has them, too
        self._runner = SiteRunner(site, str(self.folder), feedback, self._ended)
        self._show_buttons(running=True)
        self._runner.start()

    def cancel(self) -> None:
        """Stop the run."""
        if self._runner is not None:
            self.cancel_button.setEnabled(False)
            self._runner.cancel()

    @property
    def is_running(self) -> bool:
        """Whether it runs."""
        return self._runner is not None

    def let_go(self) -> None:
        """Stop a run as the window closes: its end is not shown."""
        self._is_closed = True
        self.cancel()

    def _progressed(self, percent: float) -> None:
        if not self._is_closed:
            self.bar.setValue(int(percent))

    def _heard(self, kind: str, text: str) -> None:
        if self._is_closed:
            return
        if kind == "stage":
            self.stage.setText(text)
            return
        colour = {"warning": ODD, "error": BAD}.get(kind, "#111827")
        self.log.append(f'<span style="color: {colour}">{html.escape(text)}</span>')

    def _ended(self, done: bool) -> None:  # noqa: FBT001 - of a signal
        self._runner = None
        if self._is_closed:
            return
        self.bar.setValue(100 if done else 0)
        self.stage.setText(
            tr("Done. Results: {folder}").format(folder=self.folder) if done
            else tr("Not done: the reason is below.")
        )  # fmt: skip
        self._show_buttons(running=False)

    def _show_buttons(self, *, running: bool) -> None:
        self.run_button.setEnabled(not running)
        self.cancel_button.setEnabled(running)
        for name, button in self.open_buttons.items():
            path = self.folder / name
            fresh = path.exists() and path.stat().st_mtime >= self._began - 1.0
            button.setEnabled(not running and fresh and self._began > 0.0)

    def _open(self, name: str) -> None:
        path = self.folder / name
        if path.suffix == ".qgz":
            self.wizard().open_project(path)
        elif name == "heatmap":
            self._make_sheets(path)
        else:
            QDesktopServices.openUrl(QUrl.fromLocalFile(str(path)))

    def _make_sheets(self, heatmap: Path) -> None:
        """Open the algorithm that prints sheets, filled in for this site."""
        import processing  # noqa: PLC0415 - a plugin of QGIS, there once it has started

        draft, known = self.draft, {}
        if draft.map_source or draft.attribution:
            known["SOURCE"] = "; ".join(filter(None, (draft.map_source, draft.attribution)))
        self.sheets = processing.createAlgorithmDialog("gisradar:exportreport", {
            "HEATMAP": str(heatmap), "TITLE": draft.title, "OUTPUT": str(self.folder / "sheets"),
            **known,
        })  # fmt: skip
        self.sheets.show()
