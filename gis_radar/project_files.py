"""Files of QGIS projects, written so that it can be told later whether somebody has edited one."""

from __future__ import annotations

import hashlib
import itertools
import zipfile
from pathlib import Path

from gis_radar.outputs import whole_file

_MARK = b"gis_radar "


def write_project_file(path: Path, text: str) -> None:
    """Write a project; the same text gives the same file.

    Its mark is gone once QGIS, or anybody else, has saved the project.

    Parameters
    ----------
    path : Path
        Ends in `.qgz`; it appears whole or not at all.
    text : str
        XML of the project.
    """
    with whole_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(f"{path.stem}.qgs"), text, zipfile.ZIP_DEFLATED)
        archive.comment = _mark(text.encode())


def was_edited(path: Path) -> bool:
    """Tell whether a file is there and is not just as :func:`write_project_file` left it."""
    if not path.exists():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            (name,) = archive.namelist()
            return archive.comment != _mark(archive.read(name))
    except (OSError, ValueError, zipfile.BadZipFile):
        return True


def unedited_name(path: Path) -> Path:
    """Return the first of `site.qgz`, `site_2.qgz`, ... that nobody has edited."""
    numbered = (path.with_stem(f"{path.stem}_{number}") for number in itertools.count(2))
    return next(name for name in itertools.chain([path], numbered) if not was_edited(name))


def _mark(content: bytes) -> bytes:
    return _MARK + hashlib.blake2b(content, digest_size=16).hexdigest().encode()
