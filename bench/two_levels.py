"""Simulated places where a road crosses another on a bridge: tiles, poses, scan, hidden tiles.

Formulas say whether a point is inside the ground, a ramp (a bank of earth, or between walls), the
deck or a house. A line of sight is blocked where it runs through one of these; a pulse of the scan
comes down at a slant and ends where it first meets one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
from pyproj import CRS

import gis_radar as gr
from gis_radar.base import Booleans, Floats
from gis_radar.hdmap import polygons

UTM = CRS.from_epsg(25832)
ORIGIN = np.array([678_000.0, 5_403_600.0])
ORIGIN_3D = np.append(ORIGIN, 0.0)
GROUND_M, CLEAR_M = 372.0, 5.2  # height of the ground; of the deck's lower side over it
REACH_M = 170.0  # of the scan from the middle, east and north
SLANTS = (0.16, 0.1)  # tangents of the pulses' angles, as in the simulated towns
UP = np.array([0.0, 0.0, 0.6])  # from a tile's centre to the point that must be in sight
STEP_M = 0.4  # in which pulses come down: less than a deck is thick


@dataclass(frozen=True, kw_only=True)
class TwoLevels:
    """An upper road that crosses a lower one.

    Parameters
    ----------
    heading_deg : float
        Of the upper road; the lower one runs east.
    upper_m, lower_m : float
        Width of the carriageways, verges and parapets not counted.
    deck_m, span_m : float
        Thickness and length of the deck.
    rise : float
        Of the ramps: height over length.
    walled : bool
        Whether walls hold the ramps; else earth at 1 : 1.5.
    houses : tuple of (east, north, half side, height)
        Blocks beside the roads, metres.
    tilt : (float, float)
        Rise of the ground to the east and to the north.
    """

    heading_deg: float
    upper_m: float
    lower_m: float
    deck_m: float
    span_m: float
    rise: float
    walled: bool
    houses: tuple[tuple[float, float, float, float], ...] = field(default=())
    tilt: tuple[float, float] = (0.0, 0.0)

    def ground(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the ground, metres."""
        return np.asarray(GROUND_M + self.tilt[0] * x + self.tilt[1] * y)

    def along(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the distances along and across the upper road from its middle, metres."""
        turn = np.radians(self.heading_deg)
        cos, sin = np.cos(turn), np.sin(turn)
        return cos * x + sin * y, cos * y - sin * x

    def road(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the upper road at points, metres."""
        u, _ = self.along(x, y)
        over = CLEAR_M + self.deck_m - np.maximum(np.abs(u) - self.span_m / 2, 0.0) * self.rise
        return self.ground(x, y) + np.maximum(over, 0.0)

    def bank(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the ground with the ramps on it, metres."""
        u, v = self.along(x, y)
        over = self.road(x, y) - self.ground(x, y)
        aside = np.maximum(np.abs(v) - self.upper_m / 2 - 1.5, 0.0)
        kept = np.where(aside > 0.0, 0.0, over) if self.walled else over - aside / 1.5
        front = np.maximum(self.span_m / 2 - np.abs(u), 0.0)  # the abutments are walls
        return self.ground(x, y) + np.where(front > 0.0, 0.0, np.maximum(kept, 0.0))

    def roof(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the roofs, -inf where no house stands."""
        top = np.full(np.shape(x), -np.inf)
        for east, north, half, height in self.houses:
            inside = (np.abs(x - east) < half) & (np.abs(y - north) < half)
            top = np.where(inside, self.ground(x, y) + height, top)
        return top

    def on_deck(self, x: Floats, y: Floats) -> Booleans:
        """Return whether a deck is over or under points."""
        u, v = self.along(x, y)
        return np.asarray((np.abs(u) <= self.span_m / 2) & (np.abs(v) <= self.upper_m / 2 + 1.5))

    def inside(self, x: Floats, y: Floats, z: Floats) -> Booleans:
        """Return whether points are inside a body."""
        solid = (z < self.bank(x, y)) | (z < self.roof(x, y))
        road = self.road(x, y)
        return np.asarray(solid | (self.on_deck(x, y) & (z < road) & (z > road - self.deck_m)))


def draw(seed: int) -> TwoLevels:
    """Draw a place."""
    rng = np.random.default_rng([20261122, seed])
    houses = []
    for side in (-1.0, 1.0):
        for east in rng.uniform(-120.0, 120.0, 4):
            half = float(rng.uniform(6.0, 11.0))
            houses.append((float(east), side * float(rng.uniform(34.0, 60.0)), half, 9.0))
    place = TwoLevels(
        heading_deg=float(rng.uniform(60.0, 120.0)),
        upper_m=float(rng.choice([7.0, 10.5, 14.0])),
        lower_m=float(rng.choice([7.0, 14.0])),
        deck_m=float(rng.uniform(0.8, 1.6)),
        span_m=float(rng.uniform(22.0, 40.0)),
        rise=float(rng.uniform(0.04, 0.09)),
        walled=bool(rng.random() < 0.5),
        houses=tuple(houses),
        tilt=(float(rng.normal(0.0, 0.01)), float(rng.normal(0.0, 0.01))),
    )
    free = [h for h in houses if abs(place.along(np.array(h[0]), np.array(h[1]))[1]) > 30.0]
    return TwoLevels(**{**vars(place), "houses": tuple(free)})


def tiles(place: TwoLevels) -> gpd.GeoDataFrame:
    """Return tiles of both roads, with the heights of their surfaces."""
    lanes, heights = [], []
    for heading, width, upper in (
        (0.0, place.lower_m, False), (place.heading_deg, place.upper_m, True)
    ):  # fmt: skip
        turn = np.radians(heading)
        ahead, left = (
            np.array([np.cos(turn), np.sin(turn)]),
            np.array([-np.sin(turn), np.cos(turn)]),
        )
        for lane in range(round(width / 3.5)):
            line = np.arange(-150.0, 150.25, 0.5)[:, None] * ahead
            right = line + (lane * 3.5 - width / 2) * left
            lefts = right + 3.5 * left
            lanes.append(np.stack([right[:-1], right[1:], lefts[1:], lefts[:-1]], axis=1))
            x, y = lanes[-1].mean(axis=1).T
            heights.append(place.road(x, y) if upper else place.ground(x, y))
    count = [len(lane) for lane in lanes]
    return gpd.GeoDataFrame(
        {
            "tile_id": np.arange(sum(count)),
            "lanelet_id": np.repeat(np.arange(len(lanes)), count),
            "index": np.concatenate([np.arange(c) for c in count]),
            "s_m": np.concatenate([np.arange(c) * 0.5 for c in count]),
            "length_m": 0.5,
            "width_m": 3.5,
            "height_m": np.concatenate(heights),
            "subtype": "road",
        },
        geometry=polygons(np.concatenate(lanes) + ORIGIN),
        crs=UTM,
    )


def poses(place: TwoLevels, seed: int) -> list[gr.Pose]:
    """Return sensors beside the lower road, under the deck, and beside the upper road."""
    rng = np.random.default_rng([20261123, seed])
    stands: list[tuple[float, float, float, float]] = []
    for east, mast in ((-60.0, 5.0), (70.0, 6.5), (-25.0, 4.0)):
        yaw = (0.0 if east < 0.0 else 180.0) + float(rng.normal(0.0, 12.0))
        stands.append((east, -place.lower_m / 2 - 3.0, mast, yaw))
    turn, aside = np.radians(place.heading_deg), place.upper_m / 2 + 1.0
    for u in (-45.0, 60.0):
        x, y = u * np.cos(turn) + aside * np.sin(turn), u * np.sin(turn) - aside * np.cos(turn)
        yaw = place.heading_deg + (0.0 if u < 0.0 else 180.0) + float(rng.normal(0.0, 12.0))
        over = float(place.road(np.array(x), np.array(y)) - place.ground(np.array(x), np.array(y)))
        stands.append((float(x), float(y), over + 6.0, yaw))
    return [
        gr.Pose(
            sensor=f"R{k}", crs=UTM, easting=ORIGIN[0] + x, northing=ORIGIN[1] + y,
            height=float(place.ground(np.array(x), np.array(y))) + over,
            yaw=yaw, pitch=3.0, roll=0.0,
            view=gr.View(azimuth_deg=120.0, elevation_deg=60.0, max_range_m=150.0),
        )
        for k, (x, y, over, yaw) in enumerate(stands, start=1)
    ]  # fmt: skip


def hidden(place: TwoLevels, eye: Floats, points: Floats) -> Booleans:
    """Return which (n, 3) points are hidden from `eye`: lines of sight are tested every 5 cm."""
    found = np.zeros(len(points), bool)
    begin = eye - ORIGIN_3D
    for row, end in enumerate(points - ORIGIN_3D):
        length = float(np.linalg.norm(end - begin))
        share = np.arange(1.5, length - 0.3, 0.05) / length
        x, y, z = (begin + share[:, None] * (end - begin)).T
        found[row] = place.inside(x, y, z).sum() >= 2
    return found


def write_scan(place: TwoLevels, path: Path, *, seed: int, per_m2: float, classified: bool) -> Path:
    """Write a scan of the place: a strip of pulses for each of `SLANTS`, noise of 3 cm."""
    rng = np.random.default_rng([20261124, seed])
    parts = [_strip(place, rng, slant, per_m2 / 2) for slant in SLANTS]
    points = np.concatenate(parts)
    x, y, z = points.T
    deck = place.on_deck(x, y) & (z > place.road(x, y) - 0.3)
    house = z < place.roof(x, y) + 0.3
    category = np.where(deck, 17, np.where(house, 6, 2)) if classified else np.ones(len(points))
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.01), ORIGIN_3D
    header.add_crs(UTM)
    las = laspy.LasData(header)
    las.xyz = points + ORIGIN_3D
    las.classification = category.astype(np.uint8)
    las.write(path)
    return path


def _strip(place: TwoLevels, rng: np.random.Generator, slant: float, per_m2: float) -> Floats:
    """Return the (n, 3) points where the pulses of a strip end."""
    count = int((2 * REACH_M) ** 2 * per_m2)
    aim = rng.uniform(-REACH_M, REACH_M, (count, 2))
    turn = rng.uniform(0.0, 2.0 * np.pi)
    lean = slant * np.array([np.cos(turn), np.sin(turn)])
    ended = np.full(count, np.nan)
    for over in np.arange(14.0, -6.0, -STEP_M):
        rows = np.flatnonzero(np.isnan(ended))
        rows = rows[_hit(place, aim[rows], lean, np.full(len(rows), over))]
        low, high = np.full(len(rows), over), np.full(len(rows), over + STEP_M)
        for _ in range(6):  # to a centimetre
            middle = (low + high) / 2.0
            hit = _hit(place, aim[rows], lean, middle)
            low, high = np.where(hit, middle, low), np.where(hit, high, middle)
        ended[rows] = low
    there = np.isfinite(ended)
    plane = aim[there] + ended[there, None] * lean
    points = np.column_stack([plane, GROUND_M + ended[there]])
    return np.asarray(points + rng.normal(0.0, 0.03, points.shape))


def _hit(place: TwoLevels, aim: Floats, lean: Floats, over: Floats) -> Booleans:
    """Return which pulses are inside a body at a height over the ground where they aim."""
    x, y = (aim + over[:, None] * lean).T
    return place.inside(x, y, GROUND_M + over)


def truth(place: TwoLevels, sensors: Sequence[gr.Pose], centres: Floats) -> list[Booleans]:
    """Return by sensor which of the tiles' (n, 3) centres are truly hidden."""
    targets = centres + UP
    return [hidden(place, pose.position, targets) for pose in sensors]
