"""Localize by the method `icp`: the paper's registration of traces to the scanned road."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gis_radar.base import INSTALL_LOCALIZE, Floats, InputError, Integers, NoAnswerError, Reporter
from gis_radar.calibration.registration.certainty import eigenvalues, is_fixed, pose_covariance
from gis_radar.calibration.registration.hypotheses import GUESS_M
from gis_radar.calibration.registration.solver import FLOOR, at_least
from gis_radar.calibration.registration.state import LEVER_M, State
from gis_radar.calibration.registration.traces import CROWD_M, Moving
from gis_radar.calibration.single.result import STAGE, Localization, Problem, common

# Step of the pose in numerical derivatives of the cost: longer than the gap between traces and
# kerb, within which the cost is constant.
_PROFILE_M = 2.0
MAST_M = 5.0  # height of the sensor over the road where the guess has no height
_HEADINGS = 8  # number of start headings where none is given, evenly spaced
_VOXEL_M = 0.5  # edge of the voxels of traces and road (the paper)
# Parameters of DBSCAN of the traces' voxels; the lanes of a street are one cluster.
_EPS_M, _MIN_POINTS = 2.0, 10
_DISTANCES_M = (10.0, 1.0, 0.5)  # largest distance of correspondences, stage by stage (the paper)
_ITERATIONS = 60  # most iterations of each stage
_MOST_GUESSES_OFF = 2.0  # largest distance of an accepted pose from the guess, in units of GUESS_M


def voxels(points: Floats, size_m: float) -> Floats:
    """Return the centres of the voxels that contain points, sorted.

    Parameters
    ----------
    points : (n, d) array
        Points, metres.
    size_m : float
        Edge of a voxel, metres.
    """
    cells: Integers = np.floor(np.asarray(points) / size_m).astype(np.int64)
    return np.asarray((np.unique(cells, axis=0) + 0.5) * size_m, dtype=np.float64)


def source_voxels(moving: Moving) -> Floats:
    """Return the traces: the voxels of the largest cluster of moving detections.

    The paper clusters the detections themselves; voxels bound the memory of DBSCAN's neighbours.

    Parameters
    ----------
    moving : Moving
        Moving detections of one window.

    Raises
    ------
    NoAnswerError
        If there is no cluster.
    InputError
        If Open3D is not installed.
    """
    o3d = _open3d()
    centres = voxels(moving.points, _VOXEL_M)
    labels = np.asarray(_point_cloud(o3d, centres).cluster_dbscan(_EPS_M, _MIN_POINTS))
    if (labels < 0).all():
        raise NoAnswerError("nothing moved on the same place often enough", hint="record longer")
    return np.asarray(centres[labels == np.argmax(np.bincount(labels[labels >= 0]))])


def register_icp(source: Floats, road: Floats, starts: list[State]) -> tuple[State, float]:
    """Register traces to the road by point-to-point ICP at three distances, eq. (1) of the paper.

    Parameters
    ----------
    source : (n, 3) array
        Traces, sensor frame, metres.
    road : (m, 3) array
        Cells of the road, local map coordinates, metres.
    starts : list of State
        Starts of the registration; the best result is returned.

    Returns
    -------
    State
        The pose.
    float
        Share of source voxels within a voxel of the road.

    Raises
    ------
    InputError
        If Open3D is not installed.
    """
    o3d = _open3d()
    traces, target = _point_cloud(o3d, source), _point_cloud(o3d, road)
    fits = [_run_icp(o3d, traces, target, start) for start in starts]
    best = max(fits, key=lambda fit: (fit.fitness, -fit.inlier_rmse))
    T_map_sensor = np.array(best.transformation)  # noqa: N806 - frames name a transform
    state = State(position=T_map_sensor[:3, 3], R_map_sensor=T_map_sensor[:3, :3], reflection=0.0)
    return state, float(best.fitness)


def start_states(place: Floats, yaw: float | None, count: int) -> list[State]:
    """Return start states at a place (local, m) with a yaw (radians), or with `count` yaws."""
    yaws = [yaw] if yaw is not None else (np.arange(count) * 2.0 * np.pi / count).tolist()
    return [
        State(
            position=place,
            R_map_sensor=Rotation.from_euler("Z", turn).as_matrix(),
            reflection=0.0,
        )
        for turn in yaws
    ]


def _run_icp(o3d: Any, source: Any, target: Any, start: State) -> Any:
    """Return Open3D's result of ICP from a start, in stages of `_DISTANCES_M`."""
    T_map_sensor = np.eye(4)  # noqa: N806 - frames name a transform
    T_map_sensor[:3, :3], T_map_sensor[:3, 3] = start.R_map_sensor, start.position
    pipeline = o3d.pipelines.registration
    for distance_m in _DISTANCES_M:
        result = pipeline.registration_icp(
            source,
            target,
            distance_m,
            T_map_sensor,
            pipeline.TransformationEstimationPointToPoint(),
            pipeline.ICPConvergenceCriteria(max_iteration=_ITERATIONS),
        )
        T_map_sensor = np.array(result.transformation)  # noqa: N806
    return result


def pose_information(source: Floats, road: Floats, state: State) -> Floats:
    """Return the (6, 6) information of a registration about its pose, in the order of a step.

    It is the curvature of the cost by second differences over steps of `_PROFILE_M` (a voxel in
    height), with correspondences found anew at each step: fixed ones would fix a trace even along
    the road. The cost is the squared distance from the road over that of a voxel; traces within a
    cell of `CROWD_M` count as one.

    Parameters
    ----------
    source : (n, 3) array
        Traces, sensor frame, metres.
    road : (m, 3) array
        Cells of the road, local map coordinates, metres.
    state : State
        The pose.
    """
    tree = cKDTree(road)
    cells = np.floor(source[:, :2] / CROWD_M).astype(np.int64)
    _, number, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    weight = 0.5 / (count[number.ravel()] * _VOXEL_M**2)

    def cost(step: Floats) -> float:
        points = state.moved(np.append(step, 0.0)).to_map(source)
        gap = tree.query(points, distance_upper_bound=_PROFILE_M)[0]
        return float(weight @ np.minimum(gap, _PROFILE_M) ** 2)

    sizes = np.array([_PROFILE_M, _PROFILE_M] + [_VOXEL_M] * 3 + [_PROFILE_M])
    sizes /= [1.0, 1.0, 1.0, *[LEVER_M] * 3]
    steps = np.diag(sizes)
    bend = np.diag([cost(step) + cost(-step) for step in steps])
    bend -= 2.0 * cost(np.zeros(6)) * np.eye(6)
    for i, j in combinations(range(6), 2):
        a, b = steps[i] / np.sqrt(2.0), steps[j] / np.sqrt(2.0)
        bend[i, j] = bend[j, i] = 0.5 * (cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b))
    curvature = bend / np.outer(sizes, sizes)
    return at_least(curvature, FLOOR * np.eye(6))


def _point_cloud(o3d: Any, points: Floats) -> Any:
    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(points)
    return cloud


def _open3d() -> Any:
    try:
        import open3d  # noqa: PLC0415 - large, and only this method needs it
    except ImportError as error:
        raise InputError(
            "the method icp needs Open3D, which is missing", hint=INSTALL_LOCALIZE
        ) from error
    return open3d


def by_icp(problem: Problem, moving: Moving, reporter: Reporter) -> Localization:
    """Localize by registration of the traces to the road's surface, as in the paper."""
    reporter.progress(STAGE, 1, 3)
    source = source_voxels(moving)
    local = problem.road - [*problem.guess[:2], 0.0]
    reach_m = float(np.hypot(source[:, 0], source[:, 1]).max()) + GUESS_M
    local = local[np.hypot(local[:, 0], local[:, 1]) < reach_m]
    if len(local) == 0:
        raise NoAnswerError("{}: no road within {:.0f} m of the guess", problem.name, reach_m)
    reporter.progress(STAGE, 2, 3)
    height = problem.guess[2] if len(problem.guess) == 3 else _mast_top(local, MAST_M)
    starts = start_states(np.array([0.0, 0.0, height]), problem.heading, _HEADINGS)
    state, fitness = register_icp(source, voxels(local, _VOXEL_M), starts)
    away_m = float(np.hypot(*state.position[:2]))
    if away_m > _MOST_GUESSES_OFF * GUESS_M:
        raise NoAnswerError(
            "{}: the registration went {:.0f} m from the guess",
            problem.name,
            away_m,
            hint="guess closer",
        )
    reporter.progress(STAGE, 3, 3)
    information = pose_information(source, local, state)
    observable = is_fixed(pose_covariance(information, state))
    evidence = {**common(moving, "icp"), "fitness": fitness, "observable": observable}
    return Localization(
        pose=problem.pose(state, evidence),
        fitness=fitness,
        observable=observable,
        eigenvalues=tuple(eigenvalues(information).tolist()),
        samples=len(source),
        traces=source,
        range_rate=np.full(len(source), np.nan),
    )


def _mast_top(local: Floats, mast_m: float) -> float:
    """Return the height (m) of a mast's top at the local (0, 0): `mast_m` over the road there."""
    nearest = np.argsort(np.hypot(local[:, 0], local[:, 1]))[:100]
    return float(np.median(local[nearest, 2])) + mast_m
