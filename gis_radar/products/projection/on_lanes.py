"""Places of detections on the lanes: lanelet, place along and across it, speed along it."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from gis_radar.base import Floats
from gis_radar.hdmap import LaneletMap, lane_graph

LEAST_ALONG = 0.2  # cosine between lane and line of sight: below, noise of 0.1 m/s is 0.5 m/s
BACKWARD_M_S = 1.0  # a detection that would drive backward faster is on another lane
DIGIT_M = 1.0 / 64.0  # a radar resolves decimetres; rounded numbers take half of the room

LANE_COLUMNS = pa.schema(
    [
        ("lanelet_id", pa.int64()),
        ("s_m", pa.float32()),
        ("d_m", pa.float32()),
        ("speed_along", pa.float32()),
    ]
)


class OnLanes:
    """Lanes for vehicles of a map, on which detections are placed.

    Parameters
    ----------
    roads : LaneletMap
        The map, in the coordinate system of the poses.
    """

    def __init__(self, roads: LaneletMap) -> None:
        self.crs = roads.crs
        self._graph = lane_graph(roads.lanelets)

    def columns(self, places: Floats, sensors: Floats, range_rate: Floats) -> list[pa.Array]:
        """Return the columns of `LANE_COLUMNS`, null off the lanes.

        Where lanes overlap, the one with the nearest middle is taken, among those along which the
        detection does not drive backward.

        Parameters
        ----------
        places, sensors : (n, 3) arrays
            Detections in the map, and where their sensor stood.
        range_rate : (n,) array
            Range rates, m/s, receding > 0.
        """
        found = self._graph.field.lanes(places[:, :2] - self._graph.origin)
        found = found[found["d_m"].abs() <= found["half_width_m"]]
        point = found["point"].to_numpy(np.int64)
        ray = places[point] - sensors[point]
        way = found["heading"].to_numpy(np.float64)
        along = ray[:, 0] * np.cos(way) + ray[:, 1] * np.sin(way)
        along /= np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
        along[np.abs(along) < LEAST_ALONG] = np.nan
        found = found.assign(speed_along=range_rate[point] / along)
        found["backward"] = found["speed_along"] < -BACKWARD_M_S
        found["aside"] = found["d_m"].abs()
        best = found.sort_values(["point", "backward", "aside"]).drop_duplicates("point")
        rows = best["point"].to_numpy(np.int64)
        known = np.zeros(len(places), np.bool_)
        known[rows] = True
        ids = np.zeros(len(places), np.int64)
        ids[rows] = self._graph.lanelet_id[best["lane"].to_numpy(np.int64)]
        columns = [pa.array(ids, mask=~known)]
        for name in ("s_m", "d_m", "speed_along"):
            values = np.full(len(places), np.nan)
            values[rows] = best[name]
            rounded = (np.rint(values / DIGIT_M) * DIGIT_M).astype(np.float32)
            columns.append(pa.array(rounded, mask=np.isnan(values)))
        return columns
