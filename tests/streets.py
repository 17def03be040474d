"""Small street scenes with traffic for localization: the truth is known, a second is enough."""

from __future__ import annotations

from dataclasses import dataclass, field

import geopandas as gpd
import laspy
import numpy as np
from pyproj import CRS
from shapely import LineString, Polygon
from sites import EAST, NORTH, START, UTM, recording

from gis_radar.hdmap import LaneletMap
from gis_radar.poses import Pose, View

WIDTH_M = 3.5
CROSSING = (((-90.0, -1.75), (90.0, -1.75)), ((90.0, 1.75), (-90.0, 1.75)),
            ((1.75, -90.0), (1.75, 90.0)), ((-1.75, 90.0), (-1.75, -90.0)))  # fmt: skip
JUNCTION = (*CROSSING[:2], ((1.75, -90.0), (1.75, 3.5)), ((-1.75, 3.5), (-1.75, -90.0)))
STRAIGHT = CROSSING[:2]


@dataclass(frozen=True, kw_only=True)
class Street:
    """Lanes around a middle, straight or bent to a circle, turned by `turn_deg`, on a slope."""

    lanes: tuple = JUNCTION
    turn_deg: float = 0.0
    middle: tuple = (EAST, NORTH)
    one_way: bool = True
    slope: tuple = (0.01, -0.006)
    radius_m: float = np.inf  # of the circle to which lines along x are bent, to the left
    crs: CRS = field(default=UTM)

    def placed(self, xy):
        xy, radius_m = np.asarray(xy, dtype=float), self.radius_m
        if np.isfinite(radius_m):
            turn, away = xy[:, 0] / radius_m, radius_m - xy[:, 1]
            xy = np.column_stack([away * np.sin(turn), radius_m - away * np.cos(turn)])
        return xy @ _turned(self.turn_deg).T + self.middle

    def local(self, place):
        """The place of the unturned, local plan that lies at a place of the map."""
        x, y = (np.asarray(place) - self.middle) @ _turned(self.turn_deg)
        if not np.isfinite(self.radius_m):
            return np.array([x, y])
        turn, away = np.arctan2(x, self.radius_m - y), np.hypot(x, self.radius_m - y)
        return np.array([self.radius_m * turn, self.radius_m - away])

    def ground(self, xy):
        """Height of the road at places of the unturned, local plan."""
        return 370.0 + np.asarray(xy) @ self.slope

    def roads(self):
        rows = []
        for number, lane in enumerate(self.lanes):
            line = LineString(np.linspace(*lane, 20))
            left, right = line.offset_curve(WIDTH_M / 2), line.offset_curve(-WIDTH_M / 2)
            left, line, right = (self.placed(np.asarray(x.coords)) for x in (left, line, right))
            rows.append(
                {
                    "lanelet_id": number,
                    "subtype": "road",
                    "speed_limit_kmh": 50.0,
                    "one_way": self.one_way,
                    "participants": ("vehicle",),
                    "left": LineString(left),
                    "right": LineString(right),
                    "centre": LineString(line),
                    "geometry": Polygon(np.vstack([left, right[::-1]])),
                }
            )
        table = gpd.GeoDataFrame(rows, geometry="geometry", crs=self.crs)
        for name in ("left", "right", "centre"):
            table[name] = gpd.GeoSeries(table[name], crs=self.crs)
        none = table.iloc[:0]
        return LaneletMap(lanelets=table, regulatory=none, problems=none, crs=self.crs, remarks=())

    def road_points(self, seed=0):
        rng = np.random.default_rng(seed)
        plan = np.vstack(
            [
                rng.uniform(0, 1, (1500, 1)) * np.subtract(lane[1], lane[0])
                + lane[0]
                + rng.uniform(-1.7, 1.7, (1500, 2))
                for lane in self.lanes
            ]
        )
        height = self.ground(plan) + rng.normal(0.0, 0.02, len(plan))
        return np.column_stack([self.placed(plan), height])

    def write_road(self, path):
        """Write the points of the road as a scan."""
        scan, points = laspy.create(point_format=6, file_version="1.4"), self.road_points()
        scan.header.scales, scan.header.offsets = [0.001] * 3, np.floor(points.min(axis=0))
        scan.header.add_crs(self.crs)
        scan.xyz = points
        scan.write(path)
        return path

    def pose(self, place=(-14.0, 11.0), over_m=6.0, yaw=-38.0, pitch=3.0, roll=1.0):
        east, north = self.placed([place])[0]
        return Pose(
            sensor="R1", crs=self.crs, easting=east, northing=north,
            height=float(self.ground(place)) + over_m,
            yaw=(yaw + self.turn_deg + 180.0) % 360.0 - 180.0, pitch=pitch, roll=roll,
            view=View(elevation_deg=60.0, max_range_m=150.0),
        )  # fmt: skip

    def detections(
        self, pose, *, vehicles=40, frames=600, seed=0, noise=None, speeds=(7.0, 14.0)
    ):  # fmt: skip
        """Time, points and range rates of vehicles that pass, as the sensor sees them.

        The seed decides the traffic; with a seed of its own for the noise, too, a sensor sees
        other spots of the same vehicles at other moments.
        """
        own = None if noise is None else np.random.default_rng([seed, noise])
        rng = np.random.default_rng(seed)
        time, xyz, rate = [], [], []
        for number in range(vehicles):
            lane = np.array(self.lanes[number % len(self.lanes)])
            along = (lane[1] - lane[0]) / np.linalg.norm(lane[1] - lane[0])
            left = np.array([-along[1], along[0]])
            speed, begin = rng.uniform(*speeds), rng.uniform(0.0, frames * 0.05 - 5.0)
            count, beside = 420, rng if own is None else np.random.default_rng([seed, number])
            drawn = rng if own is None else own
            moment = np.sort(
                drawn.uniform(
                    0.0,
                    min(np.linalg.norm(lane[1] - lane[0]) / speed, frames * 0.05 - begin),
                    count,
                )
            )
            centre = lane[0] + (moment * speed)[:, None] * along + beside.normal(0.0, 0.1) * left
            eye = self.local(pose.position[:2])
            local = np.stack([(eye - centre) @ along, (eye - centre) @ left], axis=1)
            side = np.abs(local[:, 1]) / np.abs(local).sum(axis=1) > drawn.uniform(0, 1, count)
            off = np.sign(local) * [2.2, 0.9]
            u = np.where(side, drawn.uniform(-2.2, 2.2, count), off[:, 0])
            v = np.where(side, off[:, 1], drawn.uniform(-0.9, 0.9, count))
            plan = centre + u[:, None] * along + v[:, None] * left
            height = self.ground(plan) + drawn.uniform(0.3, 0.9, count)
            point = np.column_stack([self.placed(plan), height])
            sight = point - pose.position
            motion = (self.placed(plan + along / 2) - self.placed(plan - along / 2)) * speed
            rate.append((sight[:, :2] * motion).sum(axis=1) / np.linalg.norm(sight, axis=1))
            xyz.append(pose.to_sensor(point))
            time.append(np.floor((moment + begin) / 0.05) * 0.05)
        time, xyz, rate = np.concatenate(time), np.vstack(xyz), np.concatenate(rate)
        drawn = rng if own is None else own
        xyz += drawn.normal(0.0, 0.1, xyz.shape)
        rate += drawn.normal(0.0, 0.05, len(rate))
        seen = pose.view.sees(xyz)
        order = np.argsort(time[seen], kind="stable")
        return START + time[seen][order], xyz[seen][order], rate[seen][order]

    def record(self, path, pose, *, frames=600, **options):
        """Write a recording of the scene: every frame, with a few things that stand still."""
        time, xyz, rate = self.detections(pose, frames=frames, **options)
        still = START + np.arange(frames) * 0.05
        time = np.concatenate([time, still])
        xyz = np.vstack([xyz, np.tile([20.0, 5.0, -3.0], (frames, 1))])
        rate = np.concatenate([rate, np.zeros(frames)])
        order = np.argsort(time, kind="stable")
        return recording(path, time[order], xyz[order], range_rate=rate[order])


def _turned(turn_deg):
    angle = np.radians(turn_deg)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def errors(found, true):
    """East, north, height (m) and roll, pitch, yaw (deg): found minus true."""
    turns = [getattr(found, a) - getattr(true, a) for a in ("roll", "pitch", "yaw")]
    return np.array(
        [*(found.position - true.position), *((np.array(turns) + 180.0) % 360.0 - 180.0)]
    )
