"""The last page of the site wizard: the site file is saved and checked."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

from qgis.gui import QgsFileWidget
from qgis.PyQt.QtCore import QDateTime, Qt, QTimeZone
from qgis.PyQt.QtWidgets import (
    QFormLayout,
    QHBoxLayout,
    QPlainTextEdit,
    QProgressBar,
    QTextBrowser,
)

from ..report.pages import local_time
from ..runner import Answer
from ..words import speaks_german, tr
from .draft import keep_earlier
from .page import Page, button, file_box
from .tasks import WorkerTask

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
        modes = QgsFileWidget.StorageMode
        self.site_box = file_box(tr("Site files") + " (*.toml)", modes.SaveFile)
        self.site_box.setConfirmOverwrite(False)  # an earlier file is kept beside it
        self.site_box.fileChanged.connect(self._stale)
        form.addRow(tr("Site file"), self.site_box)
        self.folder_box = file_box("", modes.GetDirectory)
        self.folder_box.fileChanged.connect(lambda _: self.completeChanged.emit())
        form.addRow(tr("Folder of the results"), self.folder_box)
        self.check_button = button(tr("Save and check"), self.check)
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
        for box, share in ((self.found, 3), (self.text, 1)):
            policy = box.sizePolicy()
            policy.setVerticalStretch(share)
            box.setSizePolicy(policy)
        self.is_good = False
        self._task: WorkerTask | None = None

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
        """Cancel the check when the user goes back; QGIS calls it."""
        self.let_go()

    def let_go(self) -> None:
        """Stop a check that runs, and ignore its answer."""
        if self._task is not None:
            self._task.let_go()
        self._task = None
        self.is_good = False
        self.check_button.setEnabled(True)
        self.bar.setVisible(False)
        self.completeChanged.emit()

    def check(self) -> None:
        """Write the site file and check it in the worker; clear what an earlier check found."""
        self.let_go()
        self.found.clear()
        if not self.save():
            return
        self.check_button.setEnabled(False)
        self.bar.setVisible(True)
        self.bar.setValue(0)
        self._task = WorkerTask.start(
            tr("Check of the site"), ["check", self.site_box.filePath()], self._checked,
            lambda percent: self.bar.setValue(int(percent)),
        )  # fmt: skip

    def save(self) -> bool:
        """Write the site file; keep one with other contents beside it."""
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

    def _checked(self, answer: Answer | str, warnings: list[str]) -> None:
        task, self._task = self._task, None
        self.check_button.setEnabled(True)
        self.bar.setVisible(False)
        if isinstance(answer, str):
            rows = task.summary.get("plausibility", []) if task else []
            self._say_whether_it_fits(rows)
            text = tr(
                "The site cannot be run: correct what does not fit, or accept it in the file."
            )
            self.say(text if rows else answer, BAD)
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
            self.save()
        rows = answer.summary.get("plausibility", [])
        self._say_whether_it_fits(rows)
        told = tuple(f"{sensor}: {verdict}" for sensor, verdict, *_ in rows)
        for line in warnings:
            if not line.startswith(told):
                self.say(line, ODD)
        self.say(tr("The site can be run."), GOOD)
        self.is_good = True
        self.completeChanged.emit()

    def _say_whether_it_fits(self, rows: list[list[str]]) -> None:
        """Show whether each sensor fits, in the words of the check: a table with its header."""
        for sensor, verdict, evidence, advice in rows[1:]:
            colour = BAD if verdict == tr("does not fit") else ODD if advice else GOOD
            told = f'<b style="color: {colour}">{html.escape(verdict)}</b>'
            told += " " if verdict == tr("fits, but") else ": "
            advised = f"<br>→ {html.escape(advice)}" if advice else ""
            self.say(f"<b>{html.escape(sensor)}</b>: {told}{html.escape(evidence)}{advised}", "")

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
        """Add a line to the findings; a line with a colour is plain text."""
        if colour:
            text = f'<span style="color: {colour}">{html.escape(text)}</span>'
        self.found.append(text)

    def isComplete(self) -> bool:  # noqa: N802
        """Return whether the check is passed."""
        return self.is_good and bool(self.folder_box.filePath())
