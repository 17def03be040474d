"""A page of the site wizard, which fills a draft, and its widgets."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from qgis.core import QgsCoordinateReferenceSystem
from qgis.gui import QgsFileWidget, QgsProjectionSelectionWidget
from qgis.PyQt.QtCore import Qt
from qgis.PyQt.QtWidgets import (
    QCheckBox,
    QDoubleSpinBox,
    QFormLayout,
    QLabel,
    QLineEdit,
    QPushButton,
    QWizardPage,
)

from ..words import tr


class Page(QWizardPage):  # type: ignore[misc]
    """A page that writes all input to the wizard's draft at once."""

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

    def bind(self, key: str, box: Any) -> Any:
        """Let a box fill in a value of the draft; return the box."""
        self.boxes[key] = box
        _listen(box, lambda value: self.keep(key, value))
        return box

    def row(self, form: QFormLayout, key: str, label: str, box: Any) -> Any:
        """Add a box that fills in a value of the draft to a form; return the box."""
        form.addRow(label, self.bind(key, box))
        return box

    def fill(self, source: Any = None) -> None:
        """Show what the draft says, or another source of the values."""
        for key, box in self.boxes.items():
            box.blockSignals(True)
            _show(box, getattr(source or self.draft, key))
            box.blockSignals(False)


def _listen(box: Any, do: Callable[[Any], None]) -> None:
    """Call with the value of a box whenever it changes."""
    if isinstance(box, QCheckBox):
        box.toggled.connect(do)
    elif isinstance(box, QDoubleSpinBox):
        box.valueChanged.connect(do)
    elif isinstance(box, QgsProjectionSelectionWidget):
        box.crsChanged.connect(lambda crs: do(_name_of(crs)))
    elif not isinstance(box, QgsFileWidget):
        box.textChanged.connect(lambda text: do(text.strip()))
    elif box.storageMode() == QgsFileWidget.StorageMode.GetMultipleFiles:
        box.fileChanged.connect(lambda text: do(_files_in(text)))
    else:
        box.fileChanged.connect(lambda text: do(text.strip()))


def _show(box: Any, value: Any) -> None:
    """Show a value in a box."""
    if isinstance(box, QCheckBox):
        box.setChecked(value)
    elif isinstance(box, QDoubleSpinBox):
        box.setValue(0.0 if math.isnan(value) else value)
    elif isinstance(box, QgsProjectionSelectionWidget):
        box.setCrs(QgsCoordinateReferenceSystem(value))
    elif isinstance(box, QgsFileWidget):
        several = isinstance(value, list)
        box.setFilePath(" ".join(f'"{path}"' for path in value) if several else value)
    else:
        box.setText(value)


def _name_of(crs: QgsCoordinateReferenceSystem) -> str:
    return str(crs.authid() or crs.toWkt()) if crs.isValid() else ""


def _files_in(text: str) -> list[str]:
    """Return the files of a box for several, which quotes each where there are more."""
    return [str(path) for path in QgsFileWidget.splitFilePaths(text) if str(path)]


def line(example: str = "") -> QLineEdit:
    """Return a box for a text."""
    box = QLineEdit()
    box.setPlaceholderText(example)
    return box


def switch(text: str, *, on: bool) -> QCheckBox:
    """Return a box to tick."""
    box = QCheckBox(text)
    box.setChecked(on)
    return box


def file_box(kinds: str, mode: Any = QgsFileWidget.StorageMode.GetFile) -> QgsFileWidget:
    """Return a box for a file, or what else the mode says."""
    box = QgsFileWidget()
    box.setStorageMode(mode)
    box.setFilter(kinds)
    return box


def crs_box(without: str) -> QgsProjectionSelectionWidget:
    """Return a box for a coordinate system, and how it is called where none is chosen."""
    box = QgsProjectionSelectionWidget()
    box.setOptionVisible(QgsProjectionSelectionWidget.CrsOption.CrsNotSet, True)
    box.setNotSetText(without)
    box.setCrs(QgsCoordinateReferenceSystem())
    return box


def note(text: str) -> QLabel:
    """Return an explanation below a box."""
    label = QLabel(text)
    label.setWordWrap(True)
    label.setTextFormat(Qt.TextFormat.PlainText)
    label.setStyleSheet("color: #4b5563")
    return label


def spin(low: float, high: float, decimals: int, value: float = 0.0) -> QDoubleSpinBox:
    """Return a box for a number."""
    box = QDoubleSpinBox()
    box.setRange(low, high)
    box.setDecimals(decimals)
    box.setGroupSeparatorShown(False)
    box.setValue(value)
    return box


def button(text: str, do: Callable[[], Any]) -> QPushButton:
    """Return a button."""
    box = QPushButton(text)
    box.clicked.connect(lambda _=False: do())
    return box
