"""Strips: chains of lanelets, each followed by its straightest successor."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from gis_radar.base import Floats, Integers
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.columns import NONE

AT_ONCE = 100_000  # points processed at once: with the lanes near them, 20 MB
ROOM_M = 0.6  # least distance from the edge of a lane at which a point is well inside it


@dataclass(frozen=True, kw_only=True)
class OnStrips:
    """Points on strips, a row each.

    Parameters
    ----------
    row : (k,) int64 array
        Index of the point.
    strip : (k,) int64 array
        Number of the strip.
    s_m, edge_m : (k,) arrays
        Distance along the strip, and distance inside the lane's edge, metres.
    heading : (k,) array
        Heading of the lane there, radians.
    """

    row: Integers
    strip: Integers
    s_m: Floats
    edge_m: Floats
    heading: Floats


@dataclass(frozen=True, kw_only=True)
class Strips:
    """Strips of a lane graph; each lanelet belongs to one.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    number : (n,) int64 array
        Number of the strip of each lanelet.
    start_m : (n,) array
        Begin of each lanelet along its strip, metres.
    """

    graph: LaneGraph
    number: Integers
    start_m: Floats

    @classmethod
    def of(cls, graph: LaneGraph) -> Strips:
        """Chain the lanelets of a graph, each to its straightest successor."""
        follower = _straightest(graph)
        leaders = set(follower.values())
        count = len(graph.lanelet_id)
        number, start = np.full(count, NONE, np.int64), np.zeros(count)
        heads = [lane for lane in range(count) if lane not in leaders]
        strip = 0
        for head in [*heads, *range(count)]:  # lanelets without a head are in circles
            lane: int | None = head
            way = 0.0
            if number[head] != NONE:
                continue
            while lane is not None and number[lane] == NONE:
                number[lane], start[lane] = strip, way
                way += float(graph.length_m[lane])
                lane = follower.get(lane)
            strip += 1
        return cls(graph=graph, number=number, start_m=start)

    def lay(self, points: Floats, near_m: float | None = None) -> OnStrips:
        """Project points (n, 2) onto strips, each onto the longest one that it is well inside.

        With `near_m`, each is projected onto every strip within that distance.
        """
        pieces = range(0, max(len(points), 1), AT_ONCE)
        parts = [self._lay(points[begin : begin + AT_ONCE], near_m) for begin in pieces]
        begins = np.repeat(pieces, [len(part.row) for part in parts])
        columns = {
            each.name: np.concatenate([getattr(part, each.name) for part in parts])
            for each in fields(OnStrips)
        }
        columns["row"] += begins
        return OnStrips(**columns)

    def _lay(self, points: Floats, near_m: float | None) -> OnStrips:
        table = self.graph.field.lanes(points)
        lane, point = table["lane"].to_numpy(), table["point"].to_numpy()
        edge = (table["half_width_m"] - table["d_m"].abs()).to_numpy()
        length = np.zeros(int(self.number.max()) + 1)
        np.maximum.at(length, self.number, self.start_m + self.graph.length_m)
        rank = np.minimum(edge, ROOM_M) * 1e4 + length[self.number[lane]]
        order = np.lexsort((-rank, point))
        if near_m is not None:
            order = order[(table["d_m"].abs().to_numpy() < near_m)[order]]
        elif len(order):
            order = order[np.concatenate([[True], np.diff(point[order]) != 0])]
        return OnStrips(
            row=point[order], strip=self.number[lane[order]],
            s_m=table["s_m"].to_numpy()[order] + self.start_m[lane[order]], edge_m=edge[order],
            heading=table["heading"].to_numpy()[order],
        )  # fmt: skip

    def place(self, strip: int, s_m: float) -> tuple[Floats, float]:
        """Return the place (2,) and the heading at a distance along a strip."""
        lanes = np.flatnonzero(self.number == strip)
        before = lanes[self.start_m[lanes] <= s_m]
        lane = before[self.start_m[before].argmax()] if len(before) else lanes[
            self.start_m[lanes].argmin()
        ]  # fmt: skip
        place, heading = self.graph.place(int(lane), np.array([s_m - self.start_m[lane]]))
        return place[0], float(heading[0])


def _straightest(graph: LaneGraph) -> dict[int, int]:
    """Return the straightest successor of each lanelet; each is the successor of one at most."""
    starts, ends = graph.first[:-1], graph.first[1:] - 1
    pairs = []
    for lane, after in enumerate(graph.successors):
        for other in after.tolist():
            turn = float(graph.heading[ends[lane]] - graph.heading[starts[other]])
            whole = float(graph.heading[ends[other]] - graph.heading[starts[other]])
            bend = abs(np.angle(np.exp(1j * turn))) + abs(whole)
            pairs.append((bend, lane, other))
    follower: dict[int, int] = {}
    taken: set[int] = set()
    for _, lane, other in sorted(pairs):
        if lane not in follower and other not in taken and lane != other:
            follower[lane] = other
            taken.add(other)
    return follower
