"""Sites of a city: its folders `site=NAME`, a dataset each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from gis_radar.base import InputError, Reporter, is_folder_name
from gis_radar.dataset.files.manifest import Manifest
from gis_radar.dataset.files.parts import single_file
from gis_radar.dataset.files.tables import RECORDINGS

SITE = "site="  # with which the names of a city's datasets begin


def site_folder(root: Path, name: str) -> Path:
    """Return the folder of the dataset of a city's site, `ROOT/site=NAME/`."""
    return root / f"{SITE}{name}"


def site_folders(root: Path) -> dict[str, Path]:
    """Return the folders of the datasets of a city by the names of their sites, ascending.

    Raises
    ------
    InputError
        If a name is none that a city file can state, or two differ by case only, or are links to
        one folder.
    """
    folders = dict[str, Path]()
    names, places = dict[str, str](), dict[Path, str]()
    for folder in sorted(root.glob(f"{SITE}?*")):
        if not Manifest.is_there(folder):
            continue
        name = folder.name.removeprefix(SITE)
        if not is_folder_name(name):
            raise InputError("{}: {} is no name of a site", root, repr(name),
                             hint="rename its folder")  # fmt: skip
        if (other := names.setdefault(name.casefold(), name)) != name:
            raise InputError("{}: two sites have one name: {} and {}", root, other, name,
                             hint="rename the folder of one")  # fmt: skip
        if (other := places.setdefault(folder.resolve(), name)) != name:
            raise InputError("{}: two sites are one folder: {} and {}", root, other, name,
                             hint="they would count twice: remove the link")  # fmt: skip
        folders[name] = folder
    return folders


def warn_of_copies(folders: Mapping[str, Path], reporter: Reporter) -> None:
    """Warn of each site that has recordings of another, as a copy of a folder has."""
    owners = dict[str, str]()
    for name, folder in folders.items():
        try:
            manifest = Manifest.read(folder)
            recordings = single_file(RECORDINGS, folder, manifest.fingerprint).read()
        except InputError:  # raised when this site is read
            continue
        digests = recordings["digest"].to_pylist()
        if other := next((owners[each] for each in digests if each in owners), None):
            reporter.warn("sites {} and {} have the same recordings: what both hold counts twice",
                          other, name)  # fmt: skip
        owners |= dict.fromkeys(digests, name)
