"""What the pages of the site wizard are made of: a page that fills a draft, and its boxes."""

from __future__ import annotations

from typing import Any

from qgis.gui import QgsFileWidget
from qgis.PyQt.QtCore import Qt
from qgis.PyQt.QtWidgets import QCheckBox, QDoubleSpinBox, QLabel, QLineEdit, QWizardPage

from ..words import tr


class Page(QWizardPage):  # type: ignore[misc]
    """A page: what is typed goes into the wizard's draft at once."""

    TITLE = ""
    SUBTITLE = ""

    def __init__(self) -> None:
        super().__init__()
        self.setTitle(tr(self.TITLE))
        self.setSubTitle(tr(self.SUBTITLE))
        self.boxes: dict[str, Any] = {}  # by key of the draft

    @property
    def draft(self) -> Any:
        """The site as it is filled in."""
        return self.wizard().draft

    def keep(self, key: str, value: Any) -> None:
        """Put a value into the draft; the button 'Next' may change."""
        setattr(self.draft, key, value)
        self.completeChanged.emit()

    def line(self, key: str, example: str = "") -> QLineEdit:
        """Return a box for a text of the draft."""
        box = QLineEdit()
        box.setPlaceholderText(example)
        box.textChanged.connect(lambda text: self.keep(key, text.strip()))
        self.boxes[key] = box
        return box

    def switch(self, key: str, text: str, *, on: bool) -> QCheckBox:
        """Return a box to tick."""
        box = QCheckBox(text)
        box.setChecked(on)
        box.toggled.connect(lambda is_on: self.keep(key, is_on))
        self.boxes[key] = box
        return box

    def fill(self) -> None:
        """Show what the draft says: of a site file that was opened."""
        for key, box in self.boxes.items():
            value = getattr(self.draft, key)
            if isinstance(value, bool):
                box.setChecked(value)
            else:
                box.setText(value)


def file_box(kinds: str, *, several: bool = False) -> QgsFileWidget:
    """Return a box for a file, or for several."""
    box = QgsFileWidget()
    mode = QgsFileWidget.StorageMode
    box.setStorageMode(mode.GetMultipleFiles if several else mode.GetFile)
    box.setFilter(kinds)
    return box


def files_in(text: str) -> list[str]:
    """Return the files of a box for several, which quotes each where there are more."""
    return [str(path) for path in QgsFileWidget.splitFilePaths(text) if str(path)]


def note(text: str) -> QLabel:
    """Return an explanation below a box."""
    label = QLabel(text)
    label.setWordWrap(True)
    label.setTextFormat(Qt.TextFormat.PlainText)
    label.setStyleSheet("color: #4b5563")
    return label


def spin(low: float, high: float, decimals: int) -> QDoubleSpinBox:
    box = QDoubleSpinBox()
    box.setRange(low, high)
    box.setDecimals(decimals)
    box.setGroupSeparatorShown(False)
    return box
