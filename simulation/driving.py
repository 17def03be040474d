"""Lane keeping: how far from the middle of their lanes drivers drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gis_radar.base import Floats
from simulation.network import Band, Lane, RoadNetwork, Turn

EASED_M = 12.0  # half of the way over which steps from lane to lane are averaged
ROUND_M = 30.0  # from an obstacle to where a driver begins to go round it, and ends
_ROUND_LEFT = 0.75  # share of obstacles that drivers pass on the left: most stand at the right edge
_ROUND_RADIUS_M = 30.0  # tighter bends have no obstacles
_MOST_ROUND = 12  # obstacles on a driver's way
_CUT_M = 6.0  # half of the way over which curvature is measured
_WANDER_LENGTH_M = 14.0  # way over which a driver's wander advances by 1 rad


@dataclass(frozen=True, kw_only=True)
class LaneKeeping:
    """Model of lane keeping; offsets are from the middle of the lane, positive to the left, metres.

    Parameters
    ----------
    mean_m : float
        Mean offset of all drivers.
    street_m : float
        Standard deviation, from street to street, of the mean offset there.
    lane_m, turn_m : float
        The same from lane to lane, and from turn to turn.
    driver_m : float
        Standard deviation from driver to driver, cut at two.
    wander_m : float
        Amplitude of a driver's slow wander.
    cut_m2, cut_most_m : float
        Offset to the inside of a bend, as a factor of its curvature (1/m), and its maximum.
    round_m, round_every_m : float
        Mean offset around obstacles at the edge, and mean way between two of these.
    straddling : float
        Share of drivers who drive on the line to a neighbouring lane, where there is one.
    """

    mean_m: float = 0.0
    street_m: float = 0.0
    lane_m: float = 0.0
    turn_m: float = 0.0
    driver_m: float = 0.15
    wander_m: float = 0.08
    cut_m2: float = 0.0
    cut_most_m: float = 0.9
    round_m: float = 0.0
    round_every_m: float = 250.0
    straddling: float = 0.0

    def on(self, network: RoadNetwork, *, seed: int) -> DrivenRoads:
        """Draw the mean offsets on the streets, lanes and turns of a network."""
        edges = sorted({lane.edge for lane in network.lanes.values()})
        rng = np.random.default_rng([seed, 1])
        drawn = self.mean_m + self.street_m * rng.normal(size=len(edges))
        of_ways = np.random.default_rng([seed, 6])
        return DrivenRoads(
            network=network,
            by_edge=dict(zip(edges, drawn.tolist(), strict=True)),
            by_way={
                name: float(of_ways.normal()) * (self.turn_m if _bends(band) else self.lane_m)
                for name, band in sorted(network.bands.items())
            },
        )

    def driver(self, rng: np.random.Generator, manner: np.random.Generator) -> Driver:
        """Draw a driver: offset and wander from `rng`, obstacles and straddling from `manner`."""
        habit = float(
            np.clip(rng.normal(0.0, self.driver_m), -2 * self.driver_m, 2 * self.driver_m)
        )
        phase = float(rng.uniform(0.0, 2.0 * np.pi))
        gaps = manner.exponential(self.round_every_m, _MOST_ROUND)
        sign = np.where(manner.random(_MOST_ROUND) < _ROUND_LEFT, 1.0, -1.0)
        by = sign * self.round_m * manner.normal(1.0, 0.2, _MOST_ROUND)
        return Driver(
            habit=habit,
            wander=self.wander_m,
            phase=phase,
            cut=(self.cut_m2, self.cut_most_m),
            round_at=np.cumsum(gaps + 2.0 * ROUND_M),
            round_by=by,
            straddles=bool(manner.random() < self.straddling),
        )


def _bends(band: Band) -> bool:
    return isinstance(band, Turn) and band.direction != "s"


@dataclass(frozen=True, kw_only=True)
class DrivenRoads:
    """A network with the mean offsets of all drivers.

    Parameters
    ----------
    network : RoadNetwork
        The lanes.
    by_edge : dict[str, float]
        Mean offset on the lanes of an edge, metres to the left.
    by_way : dict[str, float]
        Further mean offset on a lane or a turn.
    """

    network: RoadNetwork
    by_edge: dict[str, float]
    by_way: dict[str, float]

    def aside(self, lane: str) -> float:
        """Return the mean offset on one of SUMO's lanes; a turn has that of the edge it enters."""
        return self.by_edge[self._into(lane).edge] + self.by_way[self._way(lane)]

    def line(self, lane: str) -> float:
        """Return the offset of the line to a neighbouring lane; 0 without one."""
        if _bends(self.network.bands[self._way(lane)]):
            return 0.0
        into = self._into(lane)
        index = {other.index for other in self.network.lanes.values() if other.edge == into.edge}
        half = float(np.hypot(*(into.left[0] - into.right[0]))) / 2.0
        return half if into.index + 1 in index else -half if into.index - 1 in index else 0.0

    def _way(self, lane: str) -> str:
        return self.network.spans[lane][0]

    def _into(self, lane: str) -> Lane:
        """Return the lane itself, or the one that a turn enters."""
        band = self.network.bands[self._way(lane)]
        return self.network.lanes[band.target if isinstance(band, Turn) else band.id]


@dataclass(frozen=True, kw_only=True)
class Driver:
    """Offsets of a driver from the middle of the lanes; positive to the left, metres.

    Parameters
    ----------
    habit, wander, phase : float
        Constant offset, and amplitude and phase of a slow wander.
    cut : tuple of float
        `cut_m2` and `cut_most_m` of `LaneKeeping`.
    round_at, round_by : Floats
        Obstacles: where on the way, and the offset around each.
    straddles : bool
        Whether the driver drives on the line to a neighbouring lane.
    """

    habit: float
    wander: float
    phase: float
    cut: tuple[float, float]
    round_at: Floats
    round_by: Floats
    straddles: bool

    def aside(
        self, lanes: Sequence[str], heading: Floats, driven_m: Floats, roads: DrivenRoads
    ) -> Floats:
        """Return the driver's offset at each step.

        Parameters
        ----------
        lanes : sequence of str
            SUMO's lane at each step.
        heading : (n,) array
            Heading of the lane's middle there, rad, unwrapped.
        driven_m : (n,) array
            Way driven so far, ascending, metres.
        roads : DrivenRoads
            Mean offsets of all drivers.
        """
        names = np.array(lanes)
        street = np.empty(len(names))
        for lane in dict.fromkeys(lanes):
            beside = roads.line(lane) if self.straddles else 0.0
            street[names == lane] = roads.aside(lane) + beside
        own = self.habit + self.wander * np.sin(driven_m / _WANDER_LENGTH_M + self.phase)
        gain, most = self.cut
        ahead, behind = (np.interp(driven_m + d, driven_m, heading) for d in (_CUT_M, -_CUT_M))
        curvature = (ahead - behind) / (2.0 * _CUT_M)
        inside = np.clip(gain * curvature, -most, most)
        near = np.clip(np.abs(driven_m - self.round_at[:, None]) / ROUND_M, 0.0, 1.0)
        bumps = self.round_by @ np.cos(0.5 * np.pi * near) ** 2
        free = np.clip(1.0 - _ROUND_RADIUS_M * np.abs(curvature), 0.0, 1.0)
        return np.asarray(own + eased(street, driven_m) + inside + free * bumps)


def eased(value: Floats, driven_m: Floats) -> Floats:
    """Return the running mean of `value` over the way driven, so that it has no steps.

    Parameters
    ----------
    value : (n,) array
        Value at each step.
    driven_m : (n,) array
        Way driven so far, ascending, metres.
    """
    sums = np.cumsum(value[1:] * np.diff(driven_m))
    reach = 2.0 * EASED_M
    total = np.concatenate([[-reach * value[0], 0.0], sums])
    total = np.append(total, total[-1] + reach * value[-1])
    way = np.concatenate([[driven_m[0] - reach], driven_m, [driven_m[-1] + reach]])
    ahead, behind = (np.interp(driven_m + d, way, total) for d in (EASED_M, -EASED_M))
    return np.asarray((ahead - behind) / (2.0 * EASED_M))
