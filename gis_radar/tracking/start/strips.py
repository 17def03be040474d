"""Strips: chains of lanelets, each with its straightest successor."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from gis_radar.base import Floats, Integers
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.columns import NONE

_POINTS_AT_ONCE = 100_000  # points processed at once: with the lanes near them, 20 MB
_WELL_INSIDE_M = 0.6  # distance inside a lane's edge beyond which the longer strip is preferred


@dataclass(frozen=True, kw_only=True)
class OnStrips:
    """Points projected onto strips, a row for each pair.

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
            length_m = 0.0
            if number[head] != NONE:
                continue
            while lane is not None and number[lane] == NONE:
                number[lane], start[lane] = strip, length_m
                length_m += float(graph.length_m[lane])
                lane = follower.get(lane)
            strip += 1
        return cls(graph=graph, number=number, start_m=start)

    def project(self, points: Floats, near_m: float | None = None) -> OnStrips:
        """Project points onto strips, each onto the longest one that it is well inside.

        Parameters
        ----------
        points : (n, 2) array
            Points in the map, metres.
        near_m : float, optional
            If given, each is projected onto every strip whose middle is that near, metres.
        """
        pieces = range(0, max(len(points), 1), _POINTS_AT_ONCE)
        parts = [self._projected(points[k : k + _POINTS_AT_ONCE], near_m) for k in pieces]
        begins = np.repeat(pieces, [len(part.row) for part in parts])
        columns = {
            each.name: np.concatenate([getattr(part, each.name) for part in parts])
            for each in fields(OnStrips)
        }
        columns["row"] += begins
        return OnStrips(**columns)

    def _projected(self, points: Floats, near_m: float | None) -> OnStrips:
        """Project one piece of the points."""
        table = self.graph.field.lanes(points)
        lane, point = table["lane"].to_numpy(), table["point"].to_numpy()
        edge = (table["half_width_m"] - table["d_m"].abs()).to_numpy()
        length = np.zeros(int(self.number.max()) + 1)
        np.maximum.at(length, self.number, self.start_m + self.graph.length_m)
        rank = np.minimum(edge, _WELL_INSIDE_M) * 1e4 + length[self.number[lane]]
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
            turn_between = float(graph.heading[ends[lane]] - graph.heading[starts[other]])
            turn_within = float(graph.heading[ends[other]] - graph.heading[starts[other]])
            bend = abs(np.angle(np.exp(1j * turn_between))) + abs(turn_within)
            pairs.append((bend, lane, other))
    follower: dict[int, int] = {}
    taken: set[int] = set()
    for _, lane, other in sorted(pairs):
        if lane not in follower and other not in taken and lane != other:
            follower[lane] = other
            taken.add(other)
    return follower
