"""A month of a city, by the clocks of its sites: which months have data, and where they end."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import pandas as pd

from gis_radar.base import STEPS_PER_HOUR, InputError, Text, UsageError, step_begin, zone_of
from gis_radar.city.city import City
from gis_radar.dataset import Dataset, listed_hours


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
