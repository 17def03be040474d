"""Plan of a simulated city: an irregular grid of named streets, whose crossings are the sites."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Floats
from simulation.street_plans import StreetPlan

ORIGIN = (678_000.0, 5_403_600.0)  # EPSG:25832, the middle of the city
_COLUMNS, _ROWS = 5, 4  # of crossings
# Distance of crossings, how far each is displaced at most, and how far streets bow (1 sigma).
_SPACING_M, _JITTER_M, _BUMP_M = 370.0, 40.0, 18.0
_OPEN_STREET_M = 185.0  # length of streets that leave the city
_RING_M = 18.0  # radius of roundabouts
_EAST_WEST = ("Hafenstraße", "Hauptstraße", "Schulstraße", "Waldstraße")
_NORTH_SOUTH = ("Westring", "Bahnhofstraße", "Königsallee", "Gartenstraße", "Ostring")
_ASCII = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", " ": "-", ".": None})


@dataclass(frozen=True, kw_only=True)
class Street:
    """A street from a crossing to half-way to the next one.

    Parameters
    ----------
    name : str
        Name of the street.
    line : Floats
        Its axis from the crossing's middle, metres from there, ``(n, 2)``.
    main : bool
        Whether it has two lanes each way, and right of way.
    """

    name: str
    line: Floats
    main: bool

    @property
    def heading_rad(self) -> float:
        """Its direction at the edge of the crossing, counter-clockwise from grid east."""
        east, north = self.line[np.hypot(*self.line.T) >= _RING_M][0]
        return float(np.arctan2(north, east))


@dataclass(frozen=True, kw_only=True)
class Crossing:
    """A place where streets meet: a site of the city.

    Parameters
    ----------
    name, title : str
        Its name for folders, and its title for readers.
    place : (float, float)
        Easting and northing of its middle.
    kind : str
        `traffic_light` or `priority`, as SUMO calls junctions, or `roundabout`.
    streets : tuple of Street
        Counter-clockwise.
    """

    name: str
    title: str
    place: tuple[float, float]
    kind: str
    streets: tuple[Street, ...]

    def plan(self) -> tuple[StreetPlan, dict[str, str]]:
        """Return the streets as SUMO builds them, and the names of the streets by edge."""
        plan, names = StreetPlan(name=self.kind), dict[str, str]()
        headings = np.array([street.heading_rad for street in self.streets])
        if self.kind != "roundabout":
            plan.node("C", np.zeros(2), self.kind, 9.0)
        for k, street in enumerate(self.streets):
            at, line = "C", street.line
            if self.kind == "roundabout":
                at = f"R{k}"
                begin = _RING_M * np.array([np.cos(headings[k]), np.sin(headings[k])])
                line = np.vstack([begin, line[np.hypot(*line.T) > _RING_M + 2.0]])
                plan.node(at, begin, radius_m=5.0)
            lanes = (2, 2) if street.main and self.kind != "roundabout" else (1, 1)
            plan.arm(f"A{k}", at, line, lanes, rank=5 if street.main else 1)
            names |= {f"{at}_A{k}": street.name, f"A{k}_{at}": street.name}
        if self.kind == "roundabout":
            plan.ring(headings, _RING_M)
        return plan, names


def plan_city(sites: int, *, seed: int = 1) -> list[Crossing]:
    """Return the crossings of a city that have radars, from its middle outwards.

    Parameters
    ----------
    sites : int
        Their number; up to 20 are of the same grid.
    seed : int
        Seed of all random numbers.
    """
    columns, rows = _COLUMNS, _ROWS
    while columns * rows < sites:
        columns, rows = columns + 1, rows + 1
    rng = np.random.default_rng([seed, 1])
    middle = np.array([columns - 1, rows - 1]) / 2.0
    grid = {(c, r): np.array([c, r]) for c in range(columns) for r in range(rows)}
    places = {
        at: (cell - middle) * _SPACING_M + rng.uniform(-_JITTER_M, _JITTER_M, 2)
        for at, cell in grid.items()
    }
    streets: dict[tuple[int, int], list[Street]] = {at: [] for at in grid}
    main = (columns // 2, rows // 2)
    for at in grid:
        for turn, step in enumerate(((1, 0), (0, 1))):
            inside = 0 < at[0] < columns - 1 and 0 < at[1] < rows - 1
            gone = inside and (at[0] + step[0], at[1] + step[1]) in grid and rng.random() < 0.15
            is_main = at[1 - turn] == main[1 - turn]
            if is_main or not gone:
                _lay(streets, places, at, step, rng, main=is_main)
    by_reach = sorted(grid, key=lambda at: (float(np.hypot(*places[at])), at))
    return [_crossing(at, places[at], streets[at], rng) for at in by_reach][:sites]


def _lay(
    streets: dict[tuple[int, int], list[Street]], places: dict[tuple[int, int], Floats],
    at: tuple[int, int], step: tuple[int, int], rng: np.random.Generator, *, main: bool,
) -> None:  # fmt: skip
    """Add a street from a crossing to the next; a main street also leaves the city at both ends."""
    name = _name(_EAST_WEST, at[1]) if step[0] else _name(_NORTH_SOUTH, at[0])
    after, before = (at[0] + step[0], at[1] + step[1]), (at[0] - step[0], at[1] - step[1])
    bump_m = float(rng.normal(0.0, _BUMP_M))
    out = np.array(step, np.float64)
    if after in places:
        way = places[after] - places[at]
        share = np.linspace(0.0, 0.5, round(float(np.hypot(*way)) / 6.0))
        aside = np.array([-way[1], way[0]]) / np.hypot(*way) * bump_m
        there = share[:, None] * way + np.sin(np.pi * share)[:, None] * aside
        back = -share[:, None] * way + np.sin(np.pi * share)[:, None] * aside
        streets[at].append(Street(name=name, line=there, main=main))
        streets[after].append(Street(name=name, line=back, main=main))
    elif main:
        streets[at].append(Street(name=name, line=_straight(out), main=main))
    if before not in places and main:
        streets[at].append(Street(name=name, line=_straight(-out), main=main))


def _straight(way: Floats) -> Floats:
    return np.linspace(0.0, _OPEN_STREET_M, 60)[:, None] * way


def _name(names: tuple[str, ...], number: int) -> str:
    return names[number] if number < len(names) else f"{number + 1}. Straße"


def _crossing(
    at: tuple[int, int], place: Floats, streets: list[Street], rng: np.random.Generator
) -> Crossing:
    here = (_name(_EAST_WEST, at[1]), _name(_NORTH_SOUTH, at[0]))
    kinds = ("traffic_light", "priority", "roundabout")
    chance = (0.5, 0.25, 0.25) if len(streets) > 2 else (0.0, 1.0, 0.0)
    if any(street.main for street in streets):
        chance = (0.8, 0.2, 0.0) if len(streets) > 2 else chance
    return Crossing(
        name="-".join(here).lower().translate(_ASCII), title=" / ".join(here),
        place=(round(ORIGIN[0] + float(place[0]), 1), round(ORIGIN[1] + float(place[1]), 1)),
        kind=str(rng.choice(kinds, p=chance)),
        streets=tuple(sorted(streets, key=lambda street: street.heading_rad)),
    )  # fmt: skip
