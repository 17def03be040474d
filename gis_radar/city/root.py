"""A city: a folder that holds a dataset a site, as `ROOT/site=NAME/`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gis_radar.base import QUIET, InputError, Reporter
from gis_radar.city.questions import CityQuestions
from gis_radar.dataset import Dataset, open_dataset, site_folders, warn_of_copies

RESULTS = "results"
"""Folder of a city with the results of each site."""


@dataclass(frozen=True, kw_only=True, eq=False)
class City(CityQuestions):
    """City: the datasets of its sites.

    Parameters
    ----------
    root : Path
        Its folder.
    sites : mapping
        The dataset of each site, by its name, ascending.
    """

    root: Path
    sites: Mapping[str, Dataset]

    def __repr__(self) -> str:
        return f"City({str(self.root)!r}: {', '.join(self.sites)})"


def open_city(root: str | Path | City, *, reporter: Reporter = QUIET) -> City:
    """Open a city; the tables of its sites are read when they are asked for.

    Parameters
    ----------
    root : str, Path or City
        A folder with a dataset a site, `ROOT/site=NAME/`; an open city stays as it is.
    reporter : Reporter
        Receives a warning where two sites have the same recordings, or hours of a site were made by
        different methods.

    Raises
    ------
    InputError
        If it is no such folder, two sites have one name or are one folder, or a dataset is damaged
        or of a newer schema.
    """
    if isinstance(root, City):
        return root
    root = Path(root)
    if not root.is_dir():
        raise InputError("{}: is no folder", root)
    places = site_folders(root)
    if not places:
        raise InputError(
            "{}: is no city: has no dataset {}", root, "site=NAME/",
            hint="name the folder that holds the datasets of the sites",
        )  # fmt: skip
    sites = {name: open_dataset(place, reporter=reporter) for name, place in places.items()}
    warn_of_copies(places, reporter)
    return City(root=root, sites=sites)
