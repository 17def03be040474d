"""Roadside 4D radar: its frames of a scene with traffic."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from gis_radar.base import Floats
from gis_radar.poses import Pose, View
from simulation.bodies import walker_scatterers
from simulation.clutter import draw_clutter
from simulation.movement import Vehicles
from simulation.scatterers import Scatterers, ghosts, join_scatterers
from simulation.scene import Scene
from simulation.sight import Boxes, Walls, building_walls, join_boxes, parked_boxes, vehicle_boxes
from simulation.targets import Fleeting, Lasting, Targets


@dataclass(frozen=True, kw_only=True)
class RadarModel:
    """Model of a radar's measurement.

    Parameters
    ----------
    reach_m : float
        Range at which a target of 0 dBm2 is detected in half of the frames.
    density : float
        Mean number of scatter points on the front of a car; only some are detected.
    static_per_frame : float
        Mean number of detections of fixed objects.
    ghost_share, false_alarms, false_doppler_share : float
        Multipath ghosts per detection of a vehicle, false alarms per frame, and share of fixed
        detections with a wrong range rate.
    leak : float
        Share of hidden points of vehicles that are detected all the same (waves pass under cars).
    false_moving : float
        Share of the false alarms that have a random range rate; the others have none.
    false_mps, false_tail : float
        Wrong range rates are uniform up to this; a share of them reaches four times as far.
    false_from_m : float
        Least range of false alarms.
    range_m, azimuth_deg, elevation_deg, range_rate_mps, rcs_db : float
        Standard deviations of the measurement, independent from frame to frame.
    rcs_scale_db, rcs_floor_db : float
        Reported minus true RCS, and the least RCS that is reported.
    quantum : tuple of float
        Resolution of x, y, z (m), range rate (m/s) and RCS (dB) in the recording.
    cell_m, cell_deg, cell_mps : float
        Detections in one cell of range, azimuth and range rate are merged.
    most : int
        Detections a frame at most; the strongest stay.
    cycle_s, jitter_s : tuple of float, float
        Times between frames, in turn, and the standard deviation of each frame's time.
    targets : Fleeting or Lasting
        Whether a target is the same from frame to frame.
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
    false_moving: float = 0.4
    false_mps: float = 14.0
    false_tail: float = 0.0
    false_from_m: float = 0.0
    rcs_scale_db: float = 0.0
    rcs_floor_db: float = -100.0
    # powers of two leave the low bits of a float32 zero, which compresses well
    quantum: tuple[float, ...] = (2.0**-6, 2.0**-6, 2.0**-6, 2.0**-5, 0.5)
    cycle_s: tuple[float, ...] = (0.05,)
    jitter_s: float = 0.001
    targets: Fleeting | Lasting = field(default_factory=Fleeting)

    def wrong_rates(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw wrong range rates, m/s."""
        rate = rng.uniform(-self.false_mps, self.false_mps, count)
        beyond = np.abs(rate) / self.false_mps - (1.0 - self.false_tail)
        far = 1.0 + _TAIL_FACTOR * np.maximum(beyond, 0.0) / max(self.false_tail, 1e-9)
        return np.asarray(rate * far)


_TAIL_FACTOR = 3.0  # by which the largest wrong range rates exceed `false_mps`


@dataclass(frozen=True, kw_only=True)
class Radar:
    """A radar in a scene; `place_radar` makes one.

    Parameters
    ----------
    pose : Pose
        Its pose.
    view : View
        Its view.
    model : RadarModel
        Model of its measurement.
    scene : Scene
        Surroundings within its range.
    targets : Targets
        Fixed targets, and those of vehicles that last from frame to frame.
    walls, parked : Walls, Boxes
        Fixed obstacles to sight.
    """

    pose: Pose
    view: View
    model: RadarModel
    scene: Scene = field(repr=False)
    targets: Targets = field(repr=False)
    walls: Walls = field(repr=False)
    parked: Boxes = field(repr=False)

    def frame(self, vehicles: Vehicles, rng: np.random.Generator) -> Floats:
        """Return one frame.

        Parameters
        ----------
        vehicles : Vehicles
            The traffic at the frame's time.
        rng : Generator
            Random numbers.

        Returns
        -------
        (n, 5) array
            x, y, z in the sensor frame (metres), range rate (m/s), RCS (dBm2).
        """
        near = np.hypot(*(vehicles.centre - self.pose.position[:2]).T) < (
            self.view.max_range_m + 20.0
        )
        vehicles = vehicles.where(near)
        boxes = join_boxes(vehicle_boxes(vehicles, self.scene), self.parked)
        moving = self._moving_scatterers(vehicles, boxes, rng)
        fixed, wobble = self._fixed_scatterers(boxes, rng)
        seen = join_scatterers([moving, fixed])
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
        polar[:, :3] += self.targets.bias(seen.target, vehicles.time)
        return self._measured(np.vstack([polar, self._false_alarms(rng)]), rng)

    def _moving_scatterers(
        self, vehicles: Vehicles, boxes: Boxes, rng: np.random.Generator
    ) -> Scatterers:
        """Draw the detected points of vehicles, and ghosts."""
        eye = self.pose.position
        scatterers = self._bodies(vehicles, rng)
        strong = rng.random(len(scatterers.rcs)) < self._detection(scatterers.point, scatterers.rcs)
        scatterers = scatterers.where(strong)
        hidden = boxes.hide(eye, scatterers.point, scatterers.owner)
        hidden &= rng.random(len(hidden)) >= self.model.leak
        hidden |= self.walls.hide(eye, scatterers.point)
        scatterers = scatterers.where(~hidden)
        images = ghosts(scatterers, eye, self.walls, share=self.model.ghost_share, rng=rng)
        return join_scatterers([scatterers, images])

    def _bodies(self, vehicles: Vehicles, rng: np.random.Generator) -> Scatterers:
        """Return the scatter points of vehicles and of walkers."""
        walks = vehicles.kind == "walker"
        drivers, walkers = np.flatnonzero(~walks), np.flatnonzero(walks)
        driven = self.targets.vehicle_scatterers(
            vehicles.where(drivers), self.scene, self.pose.position,
            density=self.model.density, rng=rng,
        )  # fmt: skip
        walked = walker_scatterers(vehicles.where(walkers), self.scene, rng)
        walked = walked.of(self.targets.of(vehicles.number[walkers[walked.owner]]))
        return join_scatterers(
            [
                replace(driven, owner=drivers[driven.owner]),
                replace(walked, owner=walkers[walked.owner]),
            ]
        )

    def _fixed_scatterers(
        self, boxes: Boxes, rng: np.random.Generator
    ) -> tuple[Scatterers, Floats]:
        """Draw the detected fixed points, and range rates from their own motion."""
        chance = self.targets.chance
        lit = np.flatnonzero(rng.random(len(chance)) < chance)
        now, count = self.targets.clutter.where(lit), len(lit)
        scatterers = Scatterers(
            point=now.point,
            velocity=np.zeros((count, 3)),
            rcs=now.rcs + self.targets.fade(count, rng),
            owner=np.full(count, -1),
            target=lit,
        )
        wobble = rng.normal(0.0, 1.0, count) * now.wobble
        wrong = rng.random(count) < self.model.false_doppler_share
        wobble[wrong] = self.model.wrong_rates(int(wrong.sum()), rng)
        moving = len(boxes.heading) - len(self.parked.heading)
        traffic = Boxes(
            centre=boxes.centre[:moving], heading=boxes.heading[:moving], size=boxes.size[:moving]
        )
        clear = ~traffic.hide(self.pose.position, scatterers.point, scatterers.owner)
        return scatterers.where(clear), wobble[clear]

    def _detection(self, point: Floats, rcs: Floats) -> Floats:
        """Return the probability of detection; the signal falls with the fourth power of range."""
        return np.asarray(expit(_strength(point, rcs, self.pose.position, self.model.reach_m) / 2))

    def _false_alarms(self, rng: np.random.Generator) -> Floats:
        """Draw false alarms anywhere in view, some with a random range rate."""
        count = int(rng.poisson(self.model.false_alarms))
        half = np.radians([self.view.azimuth_deg, self.view.elevation_deg]) / 2.0
        rate = self.model.wrong_rates(count, rng)
        nearest = max(self.view.min_range_m, self.model.false_from_m)
        return np.column_stack(
            [
                rng.uniform(nearest, max(nearest, self.view.max_range_m), count),
                rng.uniform(-half[0], half[0], count),
                rng.uniform(-half[1], half[1], count),
                np.where(rng.random(count) < self.model.false_moving, rate, 0.0),
                rng.normal(-6.0, 4.0, count),
            ]
        )

    def _measured(self, polar: Floats, rng: np.random.Generator) -> Floats:
        """Return the detections for true range, azimuth, elevation, range rate and RCS."""
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
        polar[:, 4] = np.maximum(polar[:, 4] + model.rcs_scale_db, model.rcs_floor_db)
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
    """Return a radar in a scene.

    Parameters
    ----------
    pose : Pose
        Its pose, with the view.
    scene : Scene
        Its surroundings.
    rng : Generator
        Random numbers, for the fixed points.
    model : RadarModel, optional
        Model of its measurement.
    """
    model = model or RadarModel()
    view = pose.view or View()
    scene = scene.near(pose.position, view.max_range_m)
    drawn = draw_clutter(scene, pose.position, rng)
    drawn = drawn.where(view.sees(pose.to_sensor(drawn.point)))
    strength_db = _strength(drawn.point, drawn.rcs, pose.position, model.reach_m)
    return Radar(
        pose=replace(pose, view=view),
        view=view,
        model=model,
        scene=scene,
        targets=model.targets.draw(drawn, strength_db, model.static_per_frame, rng),
        walls=building_walls(scene),
        parked=parked_boxes(scene),
    )


def _strength(point: Floats, rcs: Floats, eye: Floats, reach_m: float) -> Floats:
    """Return the strength of points over that of a target detected in half of the frames, dB."""
    loss = 40.0 * np.log10(np.maximum(np.linalg.norm(point - eye, axis=1), 1.0) / reach_m)
    return np.asarray(rcs - loss)
