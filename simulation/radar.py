"""A roadside 4D radar: what it measures of a scene and its traffic, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from gis_radar.arrays import Booleans, Floats
from gis_radar.poses.pose import Pose, View
from simulation.clutter import Clutter, draw_clutter
from simulation.echoes import Echoes, ghosts, join_echoes, vehicle_echoes
from simulation.scene import Scene
from simulation.sight import Boxes, Walls, both, building_walls, parked_boxes, vehicle_boxes
from simulation.traffic import Vehicles


@dataclass(frozen=True, kw_only=True)
class RadarModel:
    """How well a radar measures.

    Parameters
    ----------
    reach_m : float
        Range at which a target of 0 dBm2 is seen every second time.
    density : float
        Scatter points on the front of a car, before the radar equation thins them out.
    static_per_frame : float
        Mean number of returns from fixed things.
    ghost_share, false_alarms, false_doppler_share : float
        Ghosts per vehicle return, false alarms per frame, and the share of fixed returns with a
        range rate that is wrong.
    leak : float
        Share of hidden vehicle points that are seen all the same, for waves run under cars.
    range_m, azimuth_deg, elevation_deg, range_rate_mps, rcs_db : float
        Standard deviations of the measurement.
    cell_m, cell_deg, cell_mps : float
        Returns in one cell of range, azimuth and range rate melt into one.
    most : int
        Returns a frame at most; the strongest stay.
    """

    reach_m: float = 92.0
    density: float = 1.75
    static_per_frame: float = 480.0
    ghost_share: float = 0.04
    false_alarms: float = 2.5
    false_doppler_share: float = 0.0015
    leak: float = 0.04
    range_m: float = 0.1
    azimuth_deg: float = 0.15
    elevation_deg: float = 0.45
    range_rate_mps: float = 0.05
    rcs_db: float = 2.0
    cell_m: float = 0.35
    cell_deg: float = 1.2
    cell_mps: float = 0.25
    most: int = 800


_FALSE_MPS = 14.0
_FADE_DB = 3.0


@dataclass(frozen=True, kw_only=True)
class Radar:
    """A radar that stands in a scene; `place_radar` makes one.

    Parameters
    ----------
    pose : Pose
        Where it stands and looks.
    view : View
        What it can see.
    model : RadarModel
        How well it measures.
    scene : Scene
        What is around it.
    clutter : Clutter
        The fixed points it sees.
    chance : Floats
        Chance of each fixed point to be in a frame.
    walls, parked : Walls, Boxes
        What always hides.
    """

    pose: Pose
    view: View
    model: RadarModel
    scene: Scene = field(repr=False)
    clutter: Clutter = field(repr=False)
    chance: Floats = field(repr=False)
    walls: Walls = field(repr=False)
    parked: Boxes = field(repr=False)

    def frame(self, vehicles: Vehicles, rng: np.random.Generator) -> Floats:
        """Return one frame.

        Parameters
        ----------
        vehicles : Vehicles
            The traffic at the frame's time.
        rng : Generator
            Decides what is seen and every error.

        Returns
        -------
        (n, 5) array
            x, y, z in the sensor frame (metres), range rate (m/s), RCS (dBm2).
        """
        near = np.hypot(*(vehicles.centre - self.pose.position[:2]).T) < (
            self.view.max_range_m + 20.0
        )
        vehicles = _only(vehicles, near)
        boxes = both(vehicle_boxes(vehicles, self.scene), self.parked)
        moving = self._vehicle_returns(vehicles, boxes, rng)
        fixed, wobble = self._fixed_returns(boxes, rng)
        seen = join_echoes([moving, fixed])
        rate = seen.range_rate(self.pose.position)
        rate[len(moving.rcs) :] += wobble
        local = self.pose.to_sensor(seen.point)
        flat = np.hypot(local[:, 0], local[:, 1])
        polar = np.column_stack(
            [
                np.hypot(flat, local[:, 2]),
                np.arctan2(local[:, 1], local[:, 0]),
                np.arctan2(local[:, 2], flat),
                rate,
                seen.rcs,
            ]
        )
        return self._measured(np.vstack([polar, self._false_alarms(rng)]), rng)

    def _vehicle_returns(
        self, vehicles: Vehicles, boxes: Boxes, rng: np.random.Generator
    ) -> Echoes:
        """Return the points of vehicles that are strong enough and not hidden, and ghosts."""
        eye = self.pose.position
        echoes = vehicle_echoes(vehicles, self.scene, eye, density=self.model.density, rng=rng)
        strong = rng.random(len(echoes.rcs)) < self._detection(echoes.point, echoes.rcs)
        echoes = echoes.where(strong)
        hidden = boxes.hide(eye, echoes.point, echoes.owner)
        hidden &= rng.random(len(hidden)) >= self.model.leak
        hidden |= self.walls.hide(eye, echoes.point)
        echoes = echoes.where(~hidden)
        images = ghosts(echoes, eye, self.walls, share=self.model.ghost_share, rng=rng)
        return join_echoes([echoes, images])

    def _fixed_returns(self, boxes: Boxes, rng: np.random.Generator) -> tuple[Echoes, Floats]:
        """Return the fixed points of this frame, and the range rate of their own stir."""
        now = self.clutter.where(rng.random(len(self.chance)) < self.chance)
        count = len(now.rcs)
        echoes = Echoes(
            point=now.point,
            velocity=np.zeros((count, 3)),
            rcs=now.rcs + rng.normal(0.0, _FADE_DB, count),
            owner=np.full(count, -1),
        )
        wobble = rng.normal(0.0, 1.0, count) * now.wobble
        wrong = rng.random(count) < self.model.false_doppler_share
        wobble[wrong] = rng.uniform(-_FALSE_MPS, _FALSE_MPS, int(wrong.sum()))
        moving = len(boxes.heading) - len(self.parked.heading)
        traffic = Boxes(
            centre=boxes.centre[:moving], heading=boxes.heading[:moving], size=boxes.size[:moving]
        )
        clear = ~traffic.hide(self.pose.position, echoes.point, echoes.owner)
        return echoes.where(clear), wobble[clear]

    def _detection(self, point: Floats, rcs: Floats) -> Floats:
        """Return the chance of detection by the radar equation: loss with the fourth power."""
        return _chance(point, rcs, self.pose.position, self.model.reach_m)

    def _false_alarms(self, rng: np.random.Generator) -> Floats:
        """Return noise peaks anywhere in view, some with a range rate of their own."""
        count = int(rng.poisson(self.model.false_alarms))
        half = np.radians([self.view.azimuth_deg, self.view.elevation_deg]) / 2.0
        rate = rng.uniform(-_FALSE_MPS, _FALSE_MPS, count)
        return np.column_stack(
            [
                rng.uniform(self.view.min_range_m, self.view.max_range_m, count),
                rng.uniform(-half[0], half[0], count),
                rng.uniform(-half[1], half[1], count),
                np.where(rng.random(count) < 0.4, rate, 0.0),
                rng.normal(-6.0, 4.0, count),
            ]
        )

    def _measured(self, polar: Floats, rng: np.random.Generator) -> Floats:
        """Return what the radar reports of true (range, azimuth, elevation, rate, RCS)."""
        model = self.model
        errors = np.array(
            [
                model.range_m,
                np.radians(model.azimuth_deg),
                np.radians(model.elevation_deg),
                model.range_rate_mps,
                model.rcs_db,
            ]
        )
        polar = polar[np.argsort(-polar[:, 4], kind="stable")]
        cell = np.array([model.cell_m, np.radians(model.cell_deg), model.cell_mps])
        _, first = np.unique(np.floor(polar[:, [0, 1, 3]] / cell), axis=0, return_index=True)
        polar = polar[np.sort(first)][: model.most]
        polar = polar + rng.normal(size=polar.shape) * errors
        reach, azimuth, elevation = polar[:, :3].T
        xyz = reach[:, None] * np.column_stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )
        seen = self.view.sees(xyz) & (reach > 0.0)
        return np.asarray(np.column_stack([xyz, polar[:, 3:]])[seen])


def place_radar(
    pose: Pose, scene: Scene, *, rng: np.random.Generator, model: RadarModel | None = None
) -> Radar:
    """Return a radar that stands in a scene.

    Parameters
    ----------
    pose : Pose
        Where; its view bounds what the radar can see.
    scene : Scene
        What is around it.
    rng : Generator
        Decides which fixed points scatter.
    model : RadarModel, optional
        How well it measures.
    """
    model = model or RadarModel()
    view = pose.view or View()
    scene = scene.near(pose.position, view.max_range_m)
    drawn = draw_clutter(scene, pose.position, rng)
    drawn = drawn.where(view.sees(pose.to_sensor(drawn.point)))
    chance = _chance(drawn.point, drawn.rcs, pose.position, model.reach_m)
    return Radar(
        pose=replace(pose, view=view),
        view=view,
        model=model,
        scene=scene,
        clutter=drawn,
        chance=_scaled(chance, model.static_per_frame),
        walls=building_walls(scene),
        parked=parked_boxes(scene),
    )


def _chance(point: Floats, rcs: Floats, eye: Floats, reach_m: float) -> Floats:
    loss = 40.0 * np.log10(np.maximum(np.linalg.norm(point - eye, axis=1), 1.0) / reach_m)
    return np.asarray(expit((rcs - loss) / 2.0))


def _scaled(chance: Floats, total: float) -> Floats:
    """Return chances with the wanted sum, as far as none may pass 0.95."""
    low, high = 0.0, 100.0
    for _ in range(40):
        middle = (low + high) / 2.0
        enough = float(np.minimum(chance * middle, 0.95).sum()) > total
        low, high = (low, middle) if enough else (middle, high)
    return np.minimum(chance * low, 0.95)


def _only(vehicles: Vehicles, keep: Booleans) -> Vehicles:
    return Vehicles(
        number=vehicles.number[keep],
        centre=vehicles.centre[keep],
        heading=vehicles.heading[keep],
        speed=vehicles.speed[keep],
        yaw_rate=vehicles.yaw_rate[keep],
        size=vehicles.size[keep],
    )
