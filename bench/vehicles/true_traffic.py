"""True traffic of a simulated site: every vehicle's footprint at the begin of every step.

Walkers and cyclists are no vehicles. The footprint of a vehicle over 12 m is the strip of its width
along the path that its front took.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import shapely

from gis_radar.base import Floats, Integers, step_of

# Column names, begin (UNIX seconds) and height of the ground in the files of the towns.
SHORT_NAMES = {"L": "length", "W": "width", "H": "vehicle_height"}
SHARED_START, SHARED_GROUND_M = 1_700_000_000.0, 372.0
NO_VEHICLES = ("walker", "cyclist")
LONG_M = 12.0  # footprints of longer vehicles follow the path of the front
HEAVY_M = 7.0  # longer vehicles are heavy


@dataclass(frozen=True, kw_only=True)
class TrueTraffic:
    """True vehicles.

    Parameters
    ----------
    states : DataFrame
        A row a vehicle and step, sorted by both: ``vehicle step``, ``easting northing`` (middle of
        the footprint were it straight), ``height`` of the road, ``heading`` (rad), ``speed`` (m/s),
        ``length width`` (m), ``front_e front_n``.
    bodies : DataFrame
        The same with a row a body (a trailer is one), and its height ``tall`` (m): these hide.
    kinds : dict
        Kind by vehicle; empty where not known.
    """

    states: pd.DataFrame = field(repr=False)
    bodies: pd.DataFrame = field(repr=False)
    kinds: dict[int, str] = field(repr=False)

    def within(self, first_step: int, last_step: int) -> TrueTraffic:
        """Return the rows of some steps."""
        parts = {
            name: table[table["step"].between(first_step, last_step)].reset_index(drop=True)
            for name, table in (("states", self.states), ("bodies", self.bodies))
        }
        return TrueTraffic(**parts, kinds=self.kinds)


def read_traffic(path: Path) -> TrueTraffic:
    """Read a site's ``vehicles.parquet``."""
    return traffic_of(pd.read_parquet(path))


def traffic_of(table: pd.DataFrame) -> TrueTraffic:
    """Return the traffic in a table of vehicles at every 50 ms.

    Parameters
    ----------
    table : DataFrame
        ``t id easting northing heading speed``, ``length width vehicle_height height`` (of the
        towns ``L W H z``); where they are there, ``kind part whole_length``.
    """
    table = table.rename(columns=SHORT_NAMES)
    if "height" not in table:
        table = table.assign(height=table["z"] + SHARED_GROUND_M, t=table["t"] + SHARED_START)
    kind = table["kind"] if "kind" in table else pd.Series("", index=table.index)
    part = table["part"] if "part" in table else pd.Series(0, index=table.index)
    whole = table["whole_length"] if "whole_length" in table else table["length"]
    driven = ~kind.isin(NO_VEHICLES)
    bodies = pd.DataFrame(
        {
            "vehicle": pd.factorize(table["id"])[0].astype(np.int64),
            "step": step_of(table["t"].to_numpy()),
            "easting": table["easting"], "northing": table["northing"], "height": table["height"],
            "heading": np.radians(table["heading"]), "speed": table["speed"],
            "length": table["length"], "width": table["width"], "tall": table["vehicle_height"],
            "part": part, "whole": whole, "kind": kind,
        }
    )[driven]  # fmt: skip
    bodies = bodies.sort_values(["vehicle", "step", "part"], ignore_index=True)
    first = bodies.drop_duplicates("vehicle")
    return TrueTraffic(
        states=_states(bodies[bodies["part"] == 0]),
        bodies=bodies.drop(columns=["part", "whole", "kind"]),
        kinds=dict(zip(first["vehicle"].tolist(), first["kind"].tolist(), strict=True)),
    )


def _states(drawing: pd.DataFrame) -> pd.DataFrame:
    """Return the states of whole vehicles from those of their first bodies."""
    ahead = np.column_stack([np.cos(drawing["heading"]), np.sin(drawing["heading"])])
    front = drawing[["easting", "northing"]].to_numpy() + ahead * (
        drawing["length"].to_numpy()[:, None] / 2.0
    )
    middle = front - ahead * drawing["whole"].to_numpy()[:, None] / 2.0
    states = drawing.drop(columns=["tall", "part", "kind", "length"]).rename(
        columns={"whole": "length"}
    )
    return states.assign(
        easting=middle[:, 0], northing=middle[:, 1], front_e=front[:, 0], front_n=front[:, 1]
    ).reset_index(drop=True)


def rectangles(states: pd.DataFrame) -> Floats:
    """Return the (n, 4, 2) corners of straight footprints."""
    heading = states["heading"].to_numpy()
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    along = ahead * states["length"].to_numpy()[:, None] / 2.0
    aside = left * states["width"].to_numpy()[:, None] / 2.0
    middle = states[["easting", "northing"]].to_numpy()
    corners = [-along - aside, along - aside, along + aside, -along + aside]
    return np.stack([middle + corner for corner in corners], axis=1)


def strip(path: Floats, length_m: float, width_m: float, heading: float) -> shapely.Geometry:
    """Return the strip behind the last point of a path; a path that is too short begins straight.

    Parameters
    ----------
    path : (n, 2) array
        Where the front was, oldest first.
    length_m, width_m : float
        Of the vehicle.
    heading : float
        Heading of the vehicle at the first point, radians.
    """
    before = path[0] - length_m * np.array([np.cos(heading), np.sin(heading)])
    back = np.vstack([before, path])[::-1]
    moves = np.hypot(*np.diff(back, axis=0).T)
    back = back[np.concatenate([[True], moves > 1e-6])]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(back, axis=0).T))])
    last = np.array([np.interp(length_m, s, back[:, k]) for k in (0, 1)])
    line = np.vstack([back[s < length_m], last])
    return shapely.buffer(shapely.LineString(line), width_m / 2.0, cap_style="flat")


def runs_at_rest(states: pd.DataFrame) -> tuple[Integers, Integers]:
    """Return first row and number of rows of each run in which a vehicle does not move at all."""
    place = states[["vehicle", "easting", "northing", "heading"]].to_numpy()
    follows = np.diff(states["step"].to_numpy(), prepend=-9) == 1
    begins = np.flatnonzero((np.diff(place, axis=0, prepend=np.nan) != 0).any(axis=1) | ~follows)
    return begins, np.diff(np.append(begins, len(states)))
