"""A city: a folder that holds a dataset a site, as `ROOT/site=NAME/`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import pandas as pd

from gis_radar import dataset as dataset_room
from gis_radar.base import (
    QUIET,
    CrsError,
    GisRadarError,
    InputError,
    NoAnswerError,
    Reporter,
    atomic_write,
)
from gis_radar.dataset import (
    By,
    Dataset,
    Holidays,
    Moment,
    NotMeasuredError,
    NoVehiclesError,
    SqlQueries,
    UnknownStreetError,
    open_dataset,
    site_folders,
    warn_of_copies,
)
from gis_radar.products import (
    Comparison,
    HeatMap,
    compare,
    joint_layer,
    make_heatmap,
    write_joint_layer,
)

_SITE_COLUMN = "site"
RESULTS = "results"
"""Folder of a city with the results of each site."""


@dataclass(frozen=True, kw_only=True, eq=False)
class City(SqlQueries):
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

    def queried_sites(self) -> tuple[Path, Mapping[str, Dataset]]:
        """Return folder and sites, which SQL queries are asked of; see :meth:`query`."""
        return self.root, self.sites

    def profile(
        self, street: str | None = None, *, by: By = "hour", days: str | None = None,
        begin: Moment = None, end: Moment = None, month: str | None = None,
        without: Holidays = None, language: str | None = None,
    ) -> pd.DataFrame:  # fmt: skip
        """Return the usual traffic of streets by site and direction.

        Parameters
        ----------
        street : str, optional
            Name of a street; of the sites that are on it. By default all streets.
        by, days, begin, end, month, without, language
            As for :meth:`gis_radar.Dataset.profile`.

        Returns
        -------
        DataFrame
            `site`, and the columns of :meth:`gis_radar.Dataset.profile`. Sites where nothing was
            measured in that time, or vehicles were not looked for, have no rows.

        Raises
        ------
        UsageError
            If no site is on such a street, or as :meth:`gis_radar.Dataset.profile`.
        InputError
            If no site was measured in that time, with vehicles.
        """
        profiles = self._of_sites(
            lambda dataset: dataset.profile(
                street, by=by, days=days, begin=begin, end=end, month=month, without=without,
                language=language,
            )
        )  # fmt: skip
        for name, each in profiles.items():
            each.insert(0, _SITE_COLUMN, name)
        whole: pd.DataFrame = pd.concat(profiles.values(), ignore_index=True)
        return whole

    def map(self, month: str, *, crs: Any = None) -> gpd.GeoDataFrame:
        """Return the tiles of all sites with their occupancy over a month.

        Parameters
        ----------
        month : str
            Such as `2026-10`, by the clocks of each site.
        crs : optional
            Coordinate system of the map; needed where the sites lie in several.

        Returns
        -------
        GeoDataFrame
            `site`, and the columns of a heat map's layer.

        Raises
        ------
        CrsError
            If the sites lie in several coordinate systems and none is named.
        UsageError, InputError
            If it is no month, or no site was measured in it.
        """
        return joint_layer(self._maps(month, crs), crs)

    def write_map(self, month: str, folder: str | Path, *, crs: Any = None) -> Path:
        """Write :meth:`map` as `heatmap.gpkg`: one layer, with the style of all heat maps.

        Parameters
        ----------
        month, crs
            As for :meth:`map`.
        folder : str or Path
            The folder; an earlier heat map there is replaced as a whole.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        OutputError
            If the folder cannot be written or holds other files; others as :meth:`map`.
        """
        return write_joint_layer(self._maps(month, crs), Path(folder), crs)

    def _maps(self, month: str, crs: Any) -> dict[str, HeatMap]:
        systems = {dataset.crs: name for name, dataset in self.sites.items()}
        if crs is None and len(systems) > 1:
            (site, crs_here), (other_site, crs_there), *_ = systems.items()
            raise CrsError(
                "{}: site {} lies in {}, site {} in {}",
                self.root, crs_here, site, crs_there, other_site,
                hint="name one for all sites, in Python: city.write_map(month, folder, crs=...)",
            )  # fmt: skip
        return self._of_sites(lambda dataset: make_heatmap(dataset, month=month))

    def compare(
        self, *, before: Any, after: Any, days: str | None = None, language: str | None = None,
        reporter: Reporter = QUIET,
    ) -> dict[str, Comparison]:  # fmt: skip
        """Compare the traffic of two periods at each site.

        Parameters
        ----------
        before, after, days, language
            As for :func:`gis_radar.compare`.
        reporter : Reporter
            Receives a warning for each site that cannot be compared.

        Returns
        -------
        dict
            The comparison of each site that can be compared.

        Raises
        ------
        NoAnswerError, InputError
            The error of the first site, if none can be compared.
        """
        return self._of_sites(
            lambda dataset: compare(
                dataset, before=before, after=after, days=days, language=language
            ),
            (NoAnswerError, InputError), reporter,
        )  # fmt: skip

    def write_catalogue(self, path: str | Path, *, root: str | None = None) -> None:
        """Write an SQL file that makes views of the tables of all sites in DuckDB.

        `duckdb -init catalogue.sql` opens it from any folder. The views read the files as they lie
        there, those of hours that are just being made, too; they have columns `site` and `date` or
        `month` of the folders, and no columns with other units.

        Parameters
        ----------
        path : str or Path
            The file.
        root : str, optional
            Where the city is for those who read it, such as `s3://bucket/city`; by default its
            folder.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        place = root or self.root.resolve().as_posix()
        with atomic_write(Path(path)) as part:
            folders = [each.folder for each in self.sites.values()]
            views = dataset_room.catalogue_of(folders, f"{place.rstrip('/')}/site=*")
            part.write_text(views, encoding="utf-8")

    def _of_sites(
        self, ask: Callable[[Dataset], Any],
        without: tuple[type[GisRadarError], ...] = (
            NotMeasuredError, UnknownStreetError, NoVehiclesError,
        ),
        reporter: Reporter = QUIET,
    ) -> dict[str, Any]:  # fmt: skip
        """Return the answers of the sites that have one, by name; `without` one are some errors."""
        answers, refused = dict[str, Any](), list[GisRadarError]()
        for name, dataset in self.sites.items():
            try:
                answers[name] = ask(dataset)
            except without as error:
                refused.append(error)
                if not isinstance(error, UnknownStreetError):  # a street is at few of many sites
                    reporter.warn("{} is left out: {}", name, error.message)
        if not answers:  # "nothing measured" comes before "no such street": some site may have it
            raise next((each for each in refused if isinstance(each, NotMeasuredError)), refused[0])
        return answers

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
