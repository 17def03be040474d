"""Passages: vehicles' fronts that pass the middles of lanelets."""

from __future__ import annotations

from dataclasses import dataclass, field

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import STEP_S, Booleans, Floats, Integers
from gis_radar.tracking.tables import PASSAGES_KIND

HEAVY = 0.5  # probability from which a vehicle counts as heavy


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneletPlaces:
    """Tiles along each lanelet, and its length.

    Parameters
    ----------
    lanelet_id : (m,) int64 array
        The lanelets, ascending.
    length_m : (m,) array
        Their lengths along the middle.
    first : (m + 1,) int64 array
        Position in `tile` of the first tile of each.
    tile, s_m : (n,) arrays
        Positions of all tiles by lanelet and index, and their starts along it, metres.
    """

    lanelet_id: Integers
    length_m: Floats
    first: Integers
    tile: Integers
    s_m: Floats

    @classmethod
    def of(cls, tiles: gpd.GeoDataFrame) -> LaneletPlaces:
        """Return the places of the lanelets of tiles."""
        lanelet = tiles["lanelet_id"].to_numpy(np.int64)
        order = np.lexsort((tiles["index"].to_numpy(np.int64), lanelet))
        s_m, length = (tiles[name].to_numpy(float)[order] for name in ("s_m", "length_m"))
        ids, first = np.unique(lanelet[order], return_index=True)
        first = np.append(first, len(order))
        ends = s_m[first[1:] - 1] + length[first[1:] - 1]
        return cls(lanelet_id=ids, length_m=ends, first=first, tile=order, s_m=s_m)

    def find(self, lanelet_id: pd.Series) -> Integers:
        """Return the number of each lanelet, -1 where it has no tiles or is null."""
        known = lanelet_id.notna().to_numpy()
        wanted = lanelet_id.fillna(0).to_numpy(np.int64)
        place = np.minimum(np.searchsorted(self.lanelet_id, wanted), len(self.lanelet_id) - 1)
        return np.where(known & (self.lanelet_id[place] == wanted), place, -1)

    def tile_at(self, number: Integers, s_m: Floats) -> Integers:
        """Return the position of the tile of each place along a lanelet; -1 without a lanelet."""
        room = float(self.length_m.max()) + 1.0 if len(self.length_m) else 1.0
        lanelet = np.repeat(np.arange(len(self.lanelet_id)), np.diff(self.first))
        inside = np.clip(np.nan_to_num(s_m), 0.0, self.length_m[number])
        found = np.searchsorted(lanelet * room + self.s_m, number * room + inside, side="right")
        place = np.maximum(found - 1, self.first[np.maximum(number, 0)])
        return np.where(number >= 0, self.tile[np.maximum(place, 0)], -1)


def levels_of(states: pd.DataFrame, places: LaneletPlaces, height_m: Floats) -> Floats:
    """Return the height of the road (m) under each state: that of the tile at its front.

    Off the lanes, the height at the vehicle's nearest state in time on the lanes is taken.
    """
    number = places.find(states["lanelet_id"])
    tile = places.tile_at(number, states["s_m"].to_numpy(float))
    level = pd.Series(np.where(tile >= 0, height_m[tile], np.nan))
    if level.isna().any() and np.isfinite(height_m).any():
        by_vehicle = level.groupby(states["vehicle"].to_numpy())
        level = by_vehicle.ffill().fillna(by_vehicle.bfill())
    return np.asarray(level, np.float64)


@dataclass(kw_only=True)
class PassageBook:
    """Book of passages from batch to batch: each vehicle passes a lanelet's middle once.

    Parameters
    ----------
    places : LaneletPlaces
        Places along the lanelets.
    last : DataFrame
        The last state of each vehicle up to now: `vehicle, step, number, s_m, speed`.
    counted : set of (vehicle, lanelet)
        Passages of vehicles that may go on.
    """

    places: LaneletPlaces
    last: pd.DataFrame = field(
        default_factory=lambda: pd.DataFrame(
            {"vehicle": [], "step": [], "number": [], "s_m": [], "speed": []}
        ).astype({"vehicle": np.int64, "step": np.int64, "number": np.int64})
    )
    counted: set[tuple[int, int]] = field(default_factory=set)

    def find(self, states: pd.DataFrame, vehicles: pd.DataFrame) -> pd.DataFrame:
        """Return the passages up to the last of some states, wherever a tile is visible.

        Parameters
        ----------
        states : DataFrame
            Rows of `tracks` that follow those so far.
        vehicles : DataFrame
            The vehicles of these states.

        Returns
        -------
        DataFrame
            As `PASSAGES_KIND`, and `tile`, the position of the tile at the middle.
        """
        known = states[["vehicle", "step", "s_m", "speed"]]
        known = known.assign(number=self.places.find(states["lanelet_id"]))
        rows = pd.concat([self.last, known], ignore_index=True)
        rows = rows.sort_values(["vehicle", "step"], kind="stable", ignore_index=True)
        self.last = rows.groupby("vehicle", sort=False).tail(1)
        self.last = self.last[self.last["step"] >= rows["step"].max()]
        found = _distinct(self._crossings(rows), self.counted)
        alive = set(self.last["vehicle"].tolist())
        self.counted = {each for each in self.counted if each[0] in alive}
        heavy = vehicles.set_index("vehicle")["p_heavy"] >= HEAVY
        return found.assign(heavy=heavy.reindex(found["vehicle"]).to_numpy(np.bool_))

    def _crossings(self, rows: pd.DataFrame) -> pd.DataFrame:
        """Return each crossing of a middle between two successive states of a vehicle."""
        columns = (rows[name].to_numpy() for name in ("vehicle", "step", "number", "s_m", "speed"))
        vehicle, step, number, s_m, speed = columns
        pair = np.flatnonzero((vehicle[1:] == vehicle[:-1]) & (np.diff(step) == 1))
        one, other = number[pair], number[pair + 1]
        half, length = self.places.length_m / 2, self.places.length_m
        on = (one >= 0) & (other >= 0)
        before, after = s_m[pair], s_m[pair + 1]
        went_on = (one != other) & self._follows(before, after, length[one], speed[pair] * STEP_S)
        first = on & (before < half[one]) & (went_on | (after >= half[one]) & (one == other))
        # after a change to a lane beside: that lane's middle, if the front crossed it on the way
        beside = (one != other) & ~went_on
        second = on & (after >= half[other]) & (went_on | beside & (before < half[other]))
        parts = [(pair[flag], lane[flag]) for flag, lane in ((first, one), (second, other))]
        place, lane = (np.concatenate(each) for each in zip(*parts, strict=True))
        return pd.DataFrame(
            {
                "vehicle": vehicle[place], "lanelet_id": self.places.lanelet_id[lane],
                "step": step[place], "speed": speed[place],
                "tile": self.places.tile_at(lane, half[lane]),
            }
        )  # fmt: skip

    @staticmethod
    def _follows(before: Floats, after: Floats, length: Floats, advance: Floats) -> Booleans:
        """Return whether a vehicle went on to a next lanelet rather than to one beside."""
        on_m, beside_m = length - before + after, after - before
        return np.asarray(np.abs(on_m - advance) < np.abs(beside_m - advance))


def _distinct(found: pd.DataFrame, counted: set[tuple[int, int]]) -> pd.DataFrame:
    """Return passages not counted yet, each once, by step, and add them to `counted`."""
    order = list(PASSAGES_KIND.order)
    found = found.sort_values(order, ignore_index=True)
    new = []
    for key in zip(found["vehicle"].tolist(), found["lanelet_id"].tolist(), strict=True):
        new.append(key not in counted)
        counted.add(key)
    return found[np.array(new, np.bool_)].reset_index(drop=True)
