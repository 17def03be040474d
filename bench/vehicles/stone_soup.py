"""Stone Soup as a peer: DBSCAN, Kalman filters and Hungarian assignment, as in its tutorials.

DBSCAN finds clusters of moving detections on the lanes; their means are the measurements. The model
is constant velocity; a track begins after three clusters, ends after two seconds without one, and
is smoothed. Standing vehicles are not found: their detections look like those of buildings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pandas as pd
from scenes import SceneFiles
from sklearn.cluster import DBSCAN
from stonesoup.dataassociator.tree import DetectionKDTreeGNN2D
from stonesoup.deleter.time import UpdateTimeDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.initiator.simple import MultiMeasurementInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import (
    CombinedLinearGaussianTransitionModel,
    ConstantVelocity,
)
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.smoother.kalman import KalmanSmoother
from stonesoup.tracker.simple import MultiTargetTracker
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState
from stonesoup.types.update import Update
from stonesoup.updater.kalman import KalmanUpdater

import gis_radar as gr
from gis_radar.base import STEP_S, Floats, step_of
from gis_radar.hdmap import TileGrid, quads

WINDOW_STEPS = 2  # whose detections are clustered together
MOVING_MPS = 0.5  # range rate of moving detections, at least
CLUSTER_M, LEAST_POINTS = 2.0, 2  # of DBSCAN: `eps`, `min_samples`
PLACE_SIGMA_M = 1.0  # of a cluster's mean
ACCELERATION_NOISE = 1.5  # of the velocity, m/s per root second
GATE_SIGMAS = 4.0  # Mahalanobis distance
CONFIRM_CLUSTERS, SILENT_S = 3, 2.0  # after which a track begins, and ends
REACH_M = 8.0  # clusters farther from a prediction are not compared
CAR_M, LONGEST_M, WIDTH_M = 4.2, 18.0, 1.8  # least and greatest length, and width, of a vehicle
EXTENT_MISSING_M = 0.6  # by which the extent of a cluster is less than the vehicle's length
SLOW_MPS = 1.0  # slower states have the heading of faster ones


def stone_soup(site: SceneFiles, poses: Sequence[gr.Pose]) -> pd.DataFrame:
    """Return the states of the vehicles that Stone Soup's components find."""
    return _states(_smoothed(_tracked(site, poses)))


def clusters(
    site: SceneFiles, poses: Sequence[gr.Pose]
) -> Iterator[tuple[int, list[tuple[Floats, Floats]]]]:
    """Yield the step of each window, and means and points of its clusters."""
    grid = TileGrid(quads(site.tiles()))
    steps, places = [], []
    for pose, path in zip(poses, site.recordings, strict=True):
        table = pd.read_parquet(path).dropna(subset=["x", "range_rate"])
        table = table[table["range_rate"].abs() > MOVING_MPS]
        place = pose.to_map(table[["x", "y", "z"]].to_numpy(np.float64))[:, :2]
        on = np.unique(grid.assign(place[:, 0], place[:, 1])[0])
        steps.append(step_of(table["time"].to_numpy()[on]))
        places.append(place[on])
    step, place = np.concatenate(steps), np.concatenate(places)
    window = step // WINDOW_STEPS
    order = np.argsort(window, kind="stable")
    window, place = window[order], place[order]
    for now in range(int(window[0]), int(window[-1]) + 1):
        points = place[slice(*np.searchsorted(window, [now, now + 1]))]
        found = []
        if len(points):
            label = DBSCAN(eps=CLUSTER_M, min_samples=LEAST_POINTS).fit_predict(points)
            groups = (points[label == k] for k in range(label.max() + 1))
            found = [(group.mean(axis=0), group) for group in groups]
        yield now * WINDOW_STEPS, found


def _tracked(site: SceneFiles, poses: Sequence[gr.Pose]) -> tuple[list[Any], Any, Floats]:
    """Return the tracks, their model of motion, and the origin of their coordinates."""
    origin = np.mean([pose.position[:2] for pose in poses], axis=0)
    moves = CombinedLinearGaussianTransitionModel([ConstantVelocity(ACCELERATION_NOISE**2)] * 2)
    measured = LinearGaussian(4, (0, 2), np.eye(2) * PLACE_SIGMA_M**2)
    predictor, updater = KalmanPredictor(moves), KalmanUpdater(measured)
    near = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=GATE_SIGMAS)
    associator = DetectionKDTreeGNN2D(near, predictor, updater, max_distance=REACH_M)
    prior = GaussianState([[0], [0], [0], [0]], np.diag([0.0, 100.0, 0.0, 100.0]))

    def detections() -> Iterator[tuple[datetime, set[Any]]]:
        for step, found in clusters(site, poses):
            now = datetime.fromtimestamp(step * STEP_S, UTC).replace(tzinfo=None)
            yield now, {
                Detection(middle - origin, timestamp=now, measurement_model=measured,
                          metadata={"points": points})
                for middle, points in found
            }  # fmt: skip

    tracker = MultiTargetTracker(
        initiator=MultiMeasurementInitiator(
            prior, UpdateTimeDeleter(timedelta(seconds=0.5)), associator, updater,
            measurement_model=measured, min_points=CONFIRM_CLUSTERS,
        ),
        deleter=UpdateTimeDeleter(timedelta(seconds=SILENT_S)),
        detector=detections(), data_associator=associator, updater=updater,
    )  # fmt: skip
    found: dict[int, Any] = {}
    for _, tracks in tracker:
        found |= {id(track): track for track in tracks}
    return list(found.values()), moves, origin


def _smoothed(tracked: tuple[list[Any], Any, Floats]) -> list[dict[str, Floats]]:
    """Return steps, smoothed states and length of each track."""
    tracks, moves, origin = tracked
    smoother, found = KalmanSmoother(moves), []
    for track in tracks:
        measured = [isinstance(state, Update) for state in track.states]
        last = len(measured) - measured[::-1].index(True)
        states = smoother.smooth(track[:last]).states
        vectors = np.array([np.asarray(s.state_vector, float)[:, 0] for s in states])
        heading = _headings(vectors[:, 1], vectors[:, 3])
        extents = [
            np.ptp(s.hypothesis.measurement.metadata["points"] @ [np.cos(h), np.sin(h)])
            for s, h, hit in zip(track.states[:last], heading, measured[:last], strict=True)
            if hit
        ]
        time = [s.timestamp.replace(tzinfo=UTC).timestamp() for s in states]
        found.append(
            {
                "step": step_of(np.array(time)), "place": vectors[:, [0, 2]] + origin,
                "speed": np.hypot(vectors[:, 1], vectors[:, 3]), "heading": heading,
                "length": np.clip(np.quantile(extents, 0.9) + EXTENT_MISSING_M, CAR_M, LONGEST_M),
            }
        )  # fmt: skip
    return found


def _headings(east: Floats, north: Floats) -> Floats:
    """Return unwrapped headings; a slow state has that of the nearest faster one in time."""
    speed, row = np.hypot(east, north), np.arange(len(east))
    fast = np.flatnonzero(speed > min(SLOW_MPS, float(speed.max())) - 1e-9)
    near = fast[np.abs(row[:, None] - fast).argmin(axis=1)]
    return np.asarray(np.unwrap(np.arctan2(north[near], east[near])))


def _states(tracks: list[dict[str, Floats]]) -> pd.DataFrame:
    """Return a row for each vehicle and step, interpolated between windows."""
    parts = []
    for number, track in enumerate(tracks):
        at = track["step"]
        if len(at) < 2:
            continue
        step = np.arange(at[0], at[-1] + 1)
        parts.append(
            pd.DataFrame(
                {
                    "vehicle": number, "step": step,
                    "easting": np.interp(step, at, track["place"][:, 0]),
                    "northing": np.interp(step, at, track["place"][:, 1]),
                    "heading": np.interp(step, at, track["heading"]),
                    "speed": np.interp(step, at, track["speed"]),
                    "length": float(track["length"]), "width": WIDTH_M,
                }
            )
        )  # fmt: skip
    return pd.concat(parts, ignore_index=True)
