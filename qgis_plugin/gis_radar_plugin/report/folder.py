"""The folder of a report: it appears whole or not at all, and replaces only an earlier report."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from qgis.core import QgsProcessingException, QgsVectorLayer

from ..words import tr

PROJECT, PAGES, PDF = "report.qgz", "pages.gpkg", "report.pdf"
OURS = {PAGES, PDF, PROJECT, f"{PAGES}-wal", f"{PAGES}-shm"}  # the last two: open in QGIS
PNG = ".png"


def earlier(dest: Path) -> set[str]:
    """Return the names of an earlier report's files: its pages are those that it lists."""
    pages = dest / PAGES
    layer = QgsVectorLayer(f"{pages}|layername=pages", "", "ogr") if pages.is_file() else None
    if layer is None or layer.fields().lookupField("file") < 0:
        return OURS
    return OURS | {f"{row['file']}{PNG}" for row in layer.getFeatures()}


def refuse_foreign(dest: Path) -> None:
    """Refuse a folder that holds other things than an earlier report."""
    other = {path.name for path in dest.iterdir()} - earlier(dest) if dest.is_dir() else set()
    if other:
        text = tr("{folder}: holds '{name}', which is not part of a report: name a new folder.")
        raise QgsProcessingException(text.format(folder=dest, name=min(other)))


@contextmanager
def private_folder(dest: Path) -> Iterator[Path]:
    """Give a folder beside the target that is gone afterwards."""
    with _written(dest):
        folder = tempfile.mkdtemp(prefix=f".{dest.name}.", suffix=".part", dir=dest.parent)
    try:
        yield Path(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def move(folder: Path, dest: Path) -> None:
    """Put the files of a finished report in place of an earlier one's."""
    with _written(dest):
        dest.mkdir(exist_ok=True)
        for name in earlier(dest):
            (dest / name).unlink(missing_ok=True)
        for path in folder.iterdir():
            path.replace(dest / path.name)


@contextmanager
def _written(dest: Path) -> Iterator[None]:
    """Turn an error of the file system into one sentence."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise QgsProcessingException(f"{dest}: {tr('cannot be written')}: {reason}") from error
