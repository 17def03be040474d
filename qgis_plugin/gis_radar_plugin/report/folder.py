"""The folder of a report: it appears whole or not at all, and replaces an earlier report only."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from qgis.core import QgsProcessingException, QgsVectorLayer

from ..words import tr
from .export import PAGES, PDF, PROJECT

OURS = {PAGES, PDF, PROJECT, f"{PAGES}-wal", f"{PAGES}-shm"}  # the last two: open in QGIS
PNG = ".png"


def earlier(dest: Path) -> set[str]:
    """Return the names of an earlier report's files: its pages are those that it lists."""
    pages = dest / PAGES
    if not pages.is_file():
        return OURS
    layer = QgsVectorLayer(f"{pages}|layername=pages", "", "ogr")
    if layer.fields().lookupField("file") < 0:
        return OURS
    return OURS | {f"{row['file']}{PNG}" for row in layer.getFeatures()}


class private_folder:  # noqa: N801 - reads as a function
    """A folder beside the target that is gone afterwards."""

    def __init__(self, dest: Path) -> None:
        self._dest = dest

    def __enter__(self) -> Path:
        try:
            made = tempfile.mkdtemp(
                prefix=f".{self._dest.name}.", suffix=".part", dir=self._dest.parent
            )
        except OSError as error:
            reason = error.strerror or str(error)
            text = f"{self._dest}: {tr('cannot be written')}: {reason}"
            raise QgsProcessingException(text) from error
        self._folder = Path(made)
        return self._folder

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


def move(folder: Path, dest: Path) -> None:
    """Put the files of a finished report in place of an earlier one's."""
    try:
        dest.mkdir(exist_ok=True)
        for name in earlier(dest):
            (dest / name).unlink(missing_ok=True)
        for path in folder.iterdir():
            path.replace(dest / path.name)
    except OSError as error:
        reason = error.strerror or str(error)
        raise QgsProcessingException(f"{dest}: {tr('cannot be written')}: {reason}") from error
