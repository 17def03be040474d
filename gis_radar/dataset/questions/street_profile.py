"""Profiles of streets: traffic by direction and hour of the day, day of the week, or month."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import Floats, Integers, Text, UsageError, street_label
from gis_radar.dataset.days.asked_time import DAY_NAMES, QUARTER_S, QUARTERS_PER_DAY, AskedTime
from gis_radar.dataset.days.tables import QUARTERS
from gis_radar.dataset.traffic.shifts import lanes_beside
from gis_radar.measures import LaneNetwork, lane_directions

By: TypeAlias = Literal["hour", "weekday", "month"]
_OVER_LANES = (  # sums over lanes as they are, as each stands for its own length
    "visible_km_h", "occupied_km_h", "occupied_variance", "vehicle_km", "vehicle_h",
)  # fmt: skip
SUMMED = (
    "quarters", "visible_s", "counted", "volume", "volume_variance", "heavy", *_OVER_LANES,
)  # fmt: skip
MOST_LANES = 8  # side by side in one direction


class UnknownStreetError(UsageError):
    """A street on which no lane of a dataset is."""


class StreetLanes(NamedTuple):
    """Lanes of streets, without connectors in junctions.

    Parameters
    ----------
    lane : (n,) int64 array
        Their numbers, ascending.
    direction : (n,) list of str
        Street and direction of each.
    length_m : (n,) array
        Their lengths.
    road_m : (n,) array
        Their parts of the length of the street: where two lanes lie side by side, a half of each.
    """

    lane: Integers
    direction: list[str]
    length_m: Floats
    road_m: Floats

    @classmethod
    def of(
        cls, lanes: gpd.GeoDataFrame, tiles: gpd.GeoDataFrame, network: LaneNetwork,
        street: str | None = None,
    ) -> StreetLanes:  # fmt: skip
        """Return the lanes of a street, or of all.

        Parameters
        ----------
        lanes, tiles : GeoDataFrame
            Layers of a dataset.
        network : LaneNetwork
            Their network.
        street : str, optional
            Name of the street, in small or capital letters.

        Raises
        ------
        UnknownStreetError
            If no lane is on a street of that name.
        """
        direction = np.array(lane_directions(lanes, network), object)
        known = lanes.set_index("lane").loc[network.lane.tolist()]
        kept = direction != ""
        if street is not None:
            parts = known["street_part"] if "street_part" in known else [None] * len(known)
            labels = [street_label(*each) for each in zip(known["street"], parts, strict=True)]
            names = [
                {str(each).casefold() for each in pair}
                for pair in zip(known["street"], labels, strict=True)
            ]
            kept &= np.array([street.casefold() in each for each in names])
            if not kept.any():
                known_names = ", ".join(sorted({*labels} - {""})) or Text("none")
                raise UnknownStreetError(
                    "there is no street {}",
                    repr(street),
                    hint=Text("streets here: {}", known_names),
                )
        road_m = _road_metres(tiles, network, direction)
        rows = np.flatnonzero(kept)
        return cls(
            network.lane[rows], direction[rows].tolist(), network.length_m[rows], road_m[rows]
        )


def _road_metres(tiles: gpd.GeoDataFrame, network: LaneNetwork, direction: Any) -> Floats:
    """Return the part of each lane in the length of its street: tiles side by side share theirs."""
    ids = tiles["tile_id"].to_numpy(np.int64)
    at = np.searchsorted(ids, network.tile_id)
    lane = np.full(len(ids) + 1, -1)
    lane[at] = network.tile_lane
    group = np.append(np.unique(direction, return_inverse=True)[1], -1)[lane]
    abreast = np.ones(len(ids))
    for side in lanes_beside(tiles):
        there = np.arange(len(ids))
        for _ in range(MOST_LANES):
            there = np.append(side, -1)[there]
            there[group[there] != group[:-1]] = -1
            abreast += there >= 0
    metres = network.tile_length_m / abreast[at]
    return np.asarray(np.bincount(network.tile_lane, metres, len(network.lane)), np.float64)


def street_profile(
    sums: pd.DataFrame, time: AskedTime, street: StreetLanes, by: By
) -> pd.DataFrame:
    """Return a row for each direction and cell; see :meth:`gis_radar.Dataset.profile`.

    Parameters
    ----------
    sums : DataFrame
        Sums of lanes by `month`, `weekday` and `hour`, with the columns `SUMMED`.
    time : AskedTime
        The time that they are of.
    street : StreetLanes
        The lanes.
    by : {"hour", "weekday", "month"}
        What a cell is.
    """
    sums = sums[sums["lane"].isin(street.lane)].groupby(["lane", by])[list(SUMMED)].sum()
    sums = sums.reset_index()
    row = np.searchsorted(street.lane, sums["lane"].to_numpy(np.int64))
    length, road = street.length_m[row], street.road_m[row]
    of_lanes = sums[["counted", "heavy", *_OVER_LANES]].assign(
        direction=np.array(street.direction, object)[row], cell=sums[by],
        days=sums["quarters"] / (QUARTERS if by == "hour" else QUARTERS_PER_DAY),
        vehicles_m=sums["volume"] * length, hours_m=sums["quarters"] / QUARTERS * road,
        variance=sums["volume_variance"] * length**2, visible_s_m=sums["visible_s"] * road,
    )  # fmt: skip
    asked_s = QUARTER_S * pd.Series(_cells(time, by)).value_counts().sort_index()
    cells = pd.MultiIndex.from_product(
        [sorted(set(street.direction)), asked_s.index], names=["direction", "cell"]
    )
    groups = of_lanes.groupby(["direction", "cell"])
    of = groups.sum().reindex(cells, fill_value=0.0)
    observed = street.road_m * np.isin(street.lane, sums["lane"])
    road_m = pd.Series(observed).groupby(np.array(street.direction, object)).sum()
    s_m = np.multiply.outer(road_m.to_numpy(), asked_s.to_numpy()).ravel()
    found = pd.DataFrame(
        {
            "volume_veh_h": _quotient(of["vehicles_m"], of["hours_m"]),
            "volume_se": _quotient(np.sqrt(of["variance"]), of["hours_m"]),
            "heavy_share": _quotient(of["heavy"], of["counted"]),
            "speed_kmh": _quotient(of["vehicle_km"], of["vehicle_h"]),
            "occupancy": _quotient(of["occupied_km_h"], of["visible_km_h"]),
            "occupancy_se": _quotient(np.sqrt(of["occupied_variance"]), of["visible_km_h"]),
            "days": groups["days"].max().reindex(cells, fill_value=0.0),
            "visible_share": (of["visible_s_m"] / s_m).fillna(0.0),
        }
    ).reset_index()
    if by == "weekday":
        found["cell"] = [DAY_NAMES[number] for number in found["cell"]]
    return found.rename(columns={"cell": by})


def _quotient(part: pd.Series, whole: pd.Series) -> pd.Series:
    return part / whole.where(whole > 0.0)


def _cells(time: AskedTime, by: By) -> Integers | list[str]:
    """Return the cell of each asked quarter."""
    if by == "month":
        return [f"{each // 12}-{each % 12 + 1:02d}" for each in time.month[time.asked].tolist()]
    return (time.hour if by == "hour" else time.weekday)[time.asked]
