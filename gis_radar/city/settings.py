"""The city file: the sites of a city, in TOML."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from gis_radar.base import Text
from gis_radar.site import (
    LARGEST_FILE,
    Duration,
    Name,
    Place,
    Switch,
    TextValue,
    TomlFile,
    TomlTable,
    Unfit,
    Zone,
    key,
    read_toml,
    toml_template,
)

_HINT = Text("begin with: gis-radar run --city-template > CITY.toml")


class CitySite(TomlTable):
    """A site of the city: its dataset is the folder site=NAME."""

    name: Name = key('"ostring"')
    """Its name, also that of its folders."""
    file: Place = key('"sites/ostring/SITE.toml"')
    """Its site file, as gis-radar run takes it."""


class CityFile(TomlFile):
    """A city, as its file states it; made by :func:`read_city_file`."""

    title: TextValue = key('"Example city"')
    """What the city is called."""
    timezone: Zone = key('"Europe/Berlin"', "UTC")
    """Zone of the months and days of the city's page."""
    language: Literal["en", "de"] = key('"de"', "en")
    """Language of the city's page: en or de."""
    keep: Duration | None = key('"720h"', None, "for ever")
    """How long exact tables are kept, from their hour and their making; counts stay."""
    reports: Switch = key("false", True, "true")
    """Whether each site gets a heat map and a report of its last month."""
    site: Annotated[tuple[CitySite, ...], Field(min_length=1)]
    """The sites, a table each."""

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [each.name.casefold() for each in self.site]
        for place, name in enumerate(names):
            if name in names[:place]:
                raise Unfit(
                    message=Text("two sites are called {}", repr(self.site[place].name)),
                    hint=Text("folders carry their names"),
                    at=("site", place, "name"),
                )
        return self

    @model_validator(mode="after")
    def _files_differ(self) -> Self:
        files = dict[str, str]()
        for place, each in enumerate(self.site):
            file = os.path.realpath(each.file)  # pathlib raises where links go round in circles
            if (other := files.setdefault(file, each.name)) != each.name:
                raise Unfit(
                    message=Text("sites {} and {} have one file", repr(other), repr(each.name)),
                    hint=Text("their traffic would count twice: state each site once"),
                    at=("site", place, "file"),
                )
        return self


def read_city_file(path: str | Path) -> CityFile:
    """Read a city file; the files of its sites are read when they are run.

    Parameters
    ----------
    path : str or Path
        A TOML file, described in `docs/how-to/city.md`; the paths in it are relative to its folder.

    Raises
    ------
    InputError
        If it is no TOML, a key is unknown or missing, a value does not fit, or two sites have one
        name or one file.
    """
    return read_toml(Path(path), CityFile, of_site=False, hint=_HINT)


_HEAD = """\
# A city of gis_radar. Lines without # must be filled in; the others show what else there is.
# Paths are relative to the folder of this file.
# Then: gis-radar run CITY.toml -o ROOT
"""


def is_city_file(path: str | Path) -> bool:
    """Return whether a TOML file has sites, as no site file has."""
    try:
        with Path(path).open("rb") as file:
            text = file.read(LARGEST_FILE).decode("utf-8-sig")
        return "site" in tomllib.loads(text)
    except (OSError, ValueError, RecursionError):
        return False  # read_site says what is wrong with it


def city_template() -> str:
    """Return a commented city file to fill in."""
    return toml_template(CityFile, _HEAD)
