"""The sample junction: a map, a scan, and what two radars recorded there."""

from __future__ import annotations

from pathlib import Path

from gis_radar.base import InputError


def sample_folder() -> Path:
    """Return the folder of the sample junction: inside an installed package, or beside it.

    Raises
    ------
    InputError
        If neither is there.
    """
    package = Path(__file__).parent
    for folder in (package / "sample_maps", package.parent / "sample_maps"):
        if (folder / "junction.osm").is_file():
            return folder
    raise InputError("the sample maps are missing", hint="install gis_radar again")
