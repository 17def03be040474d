"""Write the file of a QGIS project, and check whether it was edited since."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

from gis_radar.base import atomic_write

_MARK = b"gis_radar "


def write_project_file(path: Path, text: str) -> None:
    """Write a project; the same text gives the same file.

    A mark in the file, which is lost when QGIS saves the project, shows that it was not edited.
    """
    with atomic_write(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(f"{path.stem}.qgs"), text, zipfile.ZIP_DEFLATED)
        archive.comment = _mark(text.encode())


def was_edited(path: Path) -> bool:
    """Return whether a file exists and differs from what was written."""
    if not path.exists():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            (name,) = archive.namelist()
            return archive.comment != _mark(archive.read(name))
    except (OSError, ValueError, zipfile.BadZipFile):
        return True


def _mark(content: bytes) -> bytes:
    return _MARK + hashlib.blake2b(content, digest_size=16).hexdigest().encode()
