"""The sample junction as SUMO's plain XML: four arms, turn lanes, a median, a curved arm.

Local frame: metres from the middle of the junction, x to grid east, y to grid north.
Lateral places are measured from an arm's axis, positive to the left of the way out, which is
the side of the traffic that comes in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Floats
from simulation.curves import offset

LANE_WIDTH_M = 3.25
POCKET_WIDTH_M = 3.0
LIMIT_MPS = 13.89


@dataclass(frozen=True, kw_only=True)
class Arm:
    """One arm of the junction.

    Parameters
    ----------
    name : str
        W, E, S or N.
    heading_deg : float
        Direction of the way out at the junction, counter-clockwise from grid east.
    length_m : float
        From the middle of the junction to the far end.
    stop_m : float
        Where the lanes end, from the middle of the junction.
    curvature : float
        1/m, positive bends left on the way out.
    curve_from_m : float
        Where the bend begins.
    far, near, out : tuple of float
        Lateral middle of the lanes, outermost first: coming in before and after the turn
        lanes open, and going out.
    """

    name: str
    heading_deg: float
    length_m: float
    stop_m: float
    curvature: float
    curve_from_m: float
    far: tuple[float, ...]
    near: tuple[float, ...]
    out: tuple[float, ...]

    def axis(self, begin_m: float, end_m: float) -> Floats:
        """Return the axis between two distances from the middle, a vertex every 0.5 m or so."""
        s = np.linspace(0.0, self.length_m + 60.0, 1 + round(2 * (self.length_m + 60.0)))
        bend = np.clip(s - self.curve_from_m, 0.0, None)
        eased = np.where(bend < 20.0, bend**2 / 40.0, bend - 10.0)
        heading = np.radians(self.heading_deg) + self.curvature * eased
        middle = (heading[1:] + heading[:-1]) / 2
        x = np.concatenate([[0.0], np.cumsum(np.cos(middle) * np.diff(s))])
        y = np.concatenate([[0.0], np.cumsum(np.sin(middle) * np.diff(s))])
        at = np.linspace(begin_m, end_m, 1 + max(2, int(abs(end_m - begin_m) / 2.0)))
        return np.column_stack([np.interp(at, s, x), np.interp(at, s, y)])

    def along(self, begin_m: float, end_m: float, lateral_m: float) -> Floats:
        """Return a line beside the axis, drawn on the way out."""
        return offset(self.axis(begin_m, end_m), lateral_m)


MAIN = {"far": (7.125, 3.875), "near": (7.125, 3.875, 0.75), "out": (-7.125, -3.875)}
SIDE = {"far": (1.625,), "near": (4.875, 1.625), "out": (-1.625,)}
POCKET_FROM_M, POCKET_TO_M = 92.0, 70.0
RIM_M = 9.5
ENDS = ("begin", "end")

ARMS = {
    arm.name: arm
    for arm in (
        Arm(name="W", heading_deg=194.0, length_m=185.0, stop_m=18.0, curvature=0.0,
            curve_from_m=0.0, **MAIN),
        Arm(name="E", heading_deg=14.0, length_m=190.0, stop_m=18.0, curvature=-1 / 500,
            curve_from_m=40.0, **MAIN),
        Arm(name="S", heading_deg=284.0, length_m=180.0, stop_m=20.0, curvature=-1 / 95,
            curve_from_m=45.0, **SIDE),
        Arm(name="N", heading_deg=108.0, length_m=160.0, stop_m=20.0, curvature=1 / 400,
            curve_from_m=60.0, **SIDE),
    )
}  # fmt: skip

# from arm and lane, to arm and lane; lane 0 is the outermost
MOVES = (
    ("W", 0, "E", 0), ("W", 0, "S", 0), ("W", 1, "E", 1), ("W", 2, "N", 0),
    ("E", 0, "W", 0), ("E", 0, "N", 0), ("E", 1, "W", 1), ("E", 2, "S", 0),
    ("S", 0, "E", 0), ("S", 1, "N", 0), ("S", 1, "W", 1),
    ("N", 0, "S", 0), ("N", 0, "W", 0), ("N", 1, "E", 1),
)  # fmt: skip


def nodes_xml() -> str:
    """Return the nodes; their shapes cut the lanes where the plan wants them to end."""
    rims = [side for arm in ARMS.values() for side in _rim(arm, arm.stop_m)]
    rims.sort(key=lambda point: float(np.arctan2(point[1], point[0])))
    rows = [f'<node id="C" x="0" y="0" type="traffic_light" shape="{_text(np.array(rims))}"/>']
    for arm in ARMS.values():
        opening = np.array([*_rim(arm, POCKET_TO_M), *_rim(arm, POCKET_FROM_M)[::-1]])
        x, y = opening.mean(axis=0)
        rows.append(
            f'<node id="{arm.name}_open" x="{x:.3f}" y="{y:.3f}" shape="{_text(opening)}"/>'
        )
        x, y = arm.axis(0.0, arm.length_m)[-1]
        rows.extend(f'<node id="{arm.name}_{end}" x="{x:.3f}" y="{y:.3f}"/>' for end in ENDS)
    return f"<nodes>{''.join(rows)}</nodes>"


def _rim(arm: Arm, from_middle_m: float) -> tuple[Floats, Floats]:
    """Return the two ends of a line across an arm."""
    right, left = (arm.along(0.0, from_middle_m, side * RIM_M)[-1] for side in (-1.0, 1.0))
    return right, left


def _text(points: Floats) -> str:
    """Return a shape as SUMO writes it."""
    return " ".join(f"{x:.4f},{y:.4f}" for x, y in points)


def edges_xml() -> str:
    """Return the edges with the shape of every lane."""
    rows = []
    for arm in ARMS.values():
        far = [arm.along(arm.length_m, POCKET_FROM_M, -m) for m in arm.far]
        near = [arm.along(POCKET_TO_M, arm.stop_m, -m) for m in arm.near]
        out = [arm.along(arm.stop_m, arm.length_m, m) for m in arm.out]
        rows.append(_edge(f"{arm.name}_far", f"{arm.name}_begin", f"{arm.name}_open", far))
        rows.append(_edge(f"{arm.name}_near", f"{arm.name}_open", "C", near))
        rows.append(_edge(f"{arm.name}_out", "C", f"{arm.name}_end", out))
    return f"<edges>{''.join(rows)}</edges>"


def _edge(name: str, begin: str, end: str, lanes: list[Floats]) -> str:
    """Return one edge; a third lane is a turn lane and narrower."""
    rows = []
    for k, line in enumerate(lanes):
        width = POCKET_WIDTH_M if k == 2 else LANE_WIDTH_M
        rows.append(f'<lane index="{k}" width="{width}" shape="{_text(line)}"/>')
    return (
        f'<edge id="{name}" from="{begin}" to="{end}" numLanes="{len(lanes)}" '
        f'speed="{LIMIT_MPS}">{"".join(rows)}</edge>'
    )


def connections_xml() -> str:
    """Return which lane leads to which."""
    links = [(f"{a}_near", i, f"{b}_out", k) for a, i, b, k in MOVES]
    for arm in ARMS.values():
        for k, lateral in enumerate(arm.near):
            before = int(np.argmin(np.abs(np.array(arm.far) - lateral)))
            links.append((f"{arm.name}_far", before, f"{arm.name}_near", k))
    rows = [
        f'<connection from="{a}" fromLane="{i}" to="{b}" toLane="{k}"/>' for a, i, b, k in links
    ]
    return f"<connections>{''.join(rows)}</connections>"
