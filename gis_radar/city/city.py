"""A city: a folder that holds a dataset a site, as `ROOT/site=NAME/`; and its months."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import geopandas as gpd
import pandas as pd

from gis_radar import dataset as dataset_room
from gis_radar.base import (
    QUIET,
    STEPS_PER_HOUR,
    CrsError,
    GisRadarError,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    UsageError,
    atomic_write,
    step_begin,
    zone_of,
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
    listed_hours,
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


@dataclass(frozen=True, kw_only=True, eq=False)
class CityMonth:
    """A month of a city.

    Parameters
    ----------
    city : City
        The city.
    month : str
        The month, such as `2026-10`.
    hours : mapping
        By site, the complete hours since 1970 of each month.
    newest : int, optional
        The newest hour of the whole city in the month; by default of these sites.
    """

    city: City
    month: str
    hours: Mapping[str, Mapping[str, list[int]]]
    newest: int | None = None

    def of_site(self, name: str) -> CityMonth:
        """Return the month of one of the sites: what its workers need."""
        city = replace(self.city, sites={name: self.city.sites[name]})
        newest = self.last_step // STEPS_PER_HOUR
        return replace(self, city=city, hours={name: self.hours[name]}, newest=newest)

    @cached_property
    def before(self) -> CityMonth:
        """The month before."""
        earlier = str(pd.Period(self.month, "M") - 1)
        return CityMonth(city=self.city, month=earlier, hours=self.hours)

    def has_data(self, site: str) -> bool:
        """Return whether a site has complete hours in the month."""
        return bool(self.hours[site].get(self.month))

    def span(self, dataset: Dataset) -> tuple[int, int]:
        """Return the first and the last step of the month by the clocks of a site."""
        found = dataset.span(*self.period)
        assert found is not None  # noqa: S101 - both ends are given
        return found

    @property
    def period(self) -> tuple[str, str]:
        """Begin and end of the month, for the methods of a dataset."""
        period = pd.Period(self.month, "M")
        return f"{period}-01", f"{period + 1}-01"

    @cached_property
    def last_step(self) -> int:
        """Last step of the newest hour of any site in the month: no data are there after it."""
        months = (each.get(self.month) for each in self.hours.values())
        newest = max(hours[-1] for hours in months if hours) if self.newest is None else self.newest
        return (newest + 1) * STEPS_PER_HOUR - 1


def month_of(city: City, month: str | None) -> CityMonth:
    """Return a month of a city, checked.

    Parameters
    ----------
    city : City
        The city.
    month : str or None
        The month, such as `2026-10`.

    Raises
    ------
    UsageError
        If it is no month, or none is named.
    InputError
        If no site has data of it; the months that are there are named.
    """
    hours = {name: _hours_by_month(dataset) for name, dataset in city.sites.items()}
    there = ", ".join(sorted({known for each in hours.values() for known in each}))
    known = Text("there are {}", there) if there else Text("there is none")
    if month is None:
        raise UsageError("{} is a city: which month?", city.root, hint=known)
    if not re.fullmatch(r"\d{4}-(0[1-9]|1[0-2])", month):
        raise UsageError("{} is no month, expected as 2026-10", repr(month), hint=known)
    if not any(month in each for each in hours.values()):
        raise InputError("{}: has no data of {}", city.root, month, hint=known)
    return CityMonth(city=city, month=month, hours=hours)


def _hours_by_month(dataset: Dataset) -> dict[str, list[int]]:
    zone = zone_of(dataset.timezone)
    by_month: dict[str, list[int]] = {}
    for hour in listed_hours(dataset.folder):
        begin = step_begin(hour * STEPS_PER_HOUR).astimezone(zone)
        by_month.setdefault(f"{begin:%Y-%m}", []).append(hour)
    return by_month
