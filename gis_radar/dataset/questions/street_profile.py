"""Profiles of streets: traffic by direction and hour of the day, day of the week, or month."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import Floats, Integers, Text, UsageError, street_label
from gis_radar.dataset.days.asked_time import DAY_NAMES, QUARTER_S, QUARTERS_PER_DAY, AskedTime
from gis_radar.dataset.days.lane_sums import measures_of
from gis_radar.dataset.days.tables import QUARTERS
from gis_radar.dataset.traffic.shifts import lanes_beside
from gis_radar.measures import LaneNetwork, lane_directions

By: TypeAlias = Literal["hour", "weekday", "month"]
_OVER_LANES = (  # columns that lanes add to without a weight: they hold the lengths already
    "visible_km_h", "occupied_km_h", "occupied_variance", "vehicle_km", "vehicle_h",
)  # fmt: skip
SUMMED = (
    "quarters", "visible_s", "counted", "volume", "volume_variance", "heavy", *_OVER_LANES,
)  # fmt: skip
_MOST_LANES = 8  # side by side in one direction


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
        layer = lanes.set_index("lane").loc[network.lane.tolist()]
        chosen = direction != ""
        if street is not None:
            parts = layer["street_part"] if "street_part" in layer else [None] * len(layer)
            labels = [street_label(*each) for each in zip(layer["street"], parts, strict=True)]
            names = [
                {str(each).casefold() for each in pair}
                for pair in zip(layer["street"], labels, strict=True)
            ]
            chosen &= np.array([street.casefold() in each for each in names])
            if not chosen.any():
                known_names = ", ".join(sorted({*labels} - {""})) or Text("none")
                raise UnknownStreetError(
                    "there is no street {}",
                    repr(street),
                    hint=Text("streets here: {}", known_names),
                )
        road_m = _road_metres(tiles, network, direction)
        rows = np.flatnonzero(chosen)
        return cls(
            network.lane[rows], direction[rows].tolist(), network.length_m[rows], road_m[rows]
        )


def _road_metres(tiles: gpd.GeoDataFrame, network: LaneNetwork, direction: Any) -> Floats:
    """Return the part of each lane in the length of its street: tiles side by side share theirs."""
    ids = tiles["tile_id"].to_numpy(np.int64)
    row_of_tile = np.searchsorted(ids, network.tile_id)
    lane = np.full(len(ids) + 1, -1)
    lane[row_of_tile] = network.tile_lane
    group = np.append(np.unique(direction, return_inverse=True)[1], -1)[lane]
    abreast = np.ones(len(ids))
    for side in lanes_beside(tiles):
        neighbour = np.arange(len(ids))
        for _ in range(_MOST_LANES):
            neighbour = np.append(side, -1)[neighbour]
            neighbour[group[neighbour] != group[:-1]] = -1
            abreast += neighbour >= 0
    metres = network.tile_length_m / abreast[row_of_tile]
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
        Whether cells are hours of the day, days of the week or months.
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
    totals = groups.sum().reindex(cells, fill_value=0.0)
    measures = measures_of({name: totals[name] for name in _OVER_LANES})
    observed = street.road_m * np.isin(street.lane, sums["lane"])
    road_m = pd.Series(observed).groupby(np.array(street.direction, object)).sum()
    s_m = np.multiply.outer(road_m.to_numpy(), asked_s.to_numpy()).ravel()
    profile = pd.DataFrame(
        {
            "volume_veh_h": _quotient(totals["vehicles_m"], totals["hours_m"]),
            "volume_se": _quotient(np.sqrt(totals["variance"]), totals["hours_m"]),
            "heavy_share": _quotient(totals["heavy"], totals["counted"]),
            **{name: measures[name] for name in ("speed_kmh", "occupancy", "occupancy_se")},
            "days": groups["days"].max().reindex(cells, fill_value=0.0),
            "visible_share": (totals["visible_s_m"] / s_m).fillna(0.0),
        }
    ).reset_index()
    if by == "weekday":
        profile["cell"] = [DAY_NAMES[number] for number in profile["cell"]]
    return profile.rename(columns={"cell": by})


def _quotient(part: pd.Series, whole: pd.Series) -> pd.Series:
    return part / whole.where(whole > 0.0)


def _cells(time: AskedTime, by: By) -> Integers | list[str]:
    """Return the cell of each asked quarter."""
    if by == "month":
        return [f"{each // 12}-{each % 12 + 1:02d}" for each in time.month[time.asked].tolist()]
    return (time.hour if by == "hour" else time.weekday)[time.asked]
