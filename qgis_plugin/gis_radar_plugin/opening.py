"""Buttons that open the results, in the dialog of the algorithm."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from qgis.core import Qgis, QgsApplication
from qgis.PyQt import sip
from qgis.PyQt.QtCore import Q_ARG, QMetaObject, QUrl
from qgis.PyQt.QtGui import QDesktopServices

from .words import tr

PROVIDER = "gisradar"
Opened = tuple[str, Any]  # what the button says, and the file or folder that it opens, or a call

_SHOWN: list[Any] = []  # dialogs


def open_file(path: Path) -> None:
    """Open a file as the desktop does, a project in QGIS's window.

    QGIS's window asks first where the present project is not saved; `addProject` does not.
    """
    window = qgis_window()
    if path.suffix in (".qgz", ".qgs") and window is not None:
        QMetaObject.invokeMethod(window.mainWindow(), "openFile", Q_ARG(str, str(path)))
    else:
        QDesktopServices.openUrl(QUrl.fromLocalFile(str(path)))


def open_dialog(algorithm: str, parameters: dict[str, Any]) -> Any:
    """Show the dialog of an algorithm, filled in."""
    import processing  # noqa: PLC0415 - a plugin of QGIS, there once it has started

    dialog = processing.createAlgorithmDialog(f"{PROVIDER}:{algorithm}", parameters)
    # A dialog without a reference loses what Python does in it.
    _SHOWN[:] = [*(each for each in _SHOWN if not sip.isdeleted(each)), dialog]
    dialog.show()
    return dialog


def offer(algorithm: str, made: Sequence[Opened]) -> Any:
    """Show buttons that open what an algorithm made; return the message, None without a window.

    Parameters
    ----------
    algorithm : str
        Its name: its dialog gets the message, or QGIS's window where there is no dialog any more.
    made : sequence of (str, Path or callable)
        The buttons; what is not there has none.
    """
    made = [(text, do) for text, do in made if not isinstance(do, Path) or do.exists()]
    bar = _bar(algorithm) if made else None
    if bar is None:
        return None
    from qgis.PyQt.QtWidgets import QPushButton  # noqa: PLC0415 - qgis_process has no window

    message = bar.createMessage(tr("Results"), "")
    for text, do in made:
        button = QPushButton(text, message)
        if isinstance(do, Path):
            button.setToolTip(str(do))
            do = partial(open_file, do)  # noqa: PLW2901 - a call from here on
        button.clicked.connect(lambda _=False, call=do: call())
        message.layout().addWidget(button)
    return bar.pushWidget(message, Qgis.MessageLevel.Success)


def qgis_window() -> Any:
    """Return the interface of QGIS with a window, None without one."""
    try:
        from qgis.utils import iface  # noqa: PLC0415 - there once QGIS has a window
    except ImportError:
        return None
    return iface


def _bar(algorithm: str) -> Any:
    """Return the message bar of an algorithm's dialog, else that of the window."""
    if not hasattr(QgsApplication.instance(), "topLevelWidgets"):
        return None
    from qgis.gui import QgsProcessingAlgorithmDialogBase  # noqa: PLC0415 - as above

    for widget in QgsApplication.topLevelWidgets():
        if isinstance(widget, QgsProcessingAlgorithmDialogBase) and widget.isVisible():
            shown = widget.algorithm()
            if shown is not None and shown.name() == algorithm:
                return widget.messageBar()
    window = qgis_window()
    return window.messageBar() if window is not None else None
