"""Joint calibration of a site's sensors: candidate poses of each, and the poses that fit all."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from gis_radar import calibration, hdmap, scans
from gis_radar.base import (
    SILENT,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    atomic_write,
    read_json,
    restored,
    with_texts,
)
from gis_radar.poses import Pose, pose_from_dict, read_pose

POSE_FILE, CANDIDATES_FILE, RECORDING_FILE = (
    "localization.json",
    "candidates.json",
    "recording.parquet",
)
Record = dict[str, Any]


def write_candidates(refusal: calibration.AmbiguousError, sensor: str, path: Path) -> None:
    """Write the candidate poses of a sensor, and the reason why it is refused alone."""
    poses = [replace(each.pose, sensor=sensor).as_dict() for each in refusal.answers]
    _write(path, {"message": refusal.message, "hint": refusal.hint, "poses": poses})


def refuse_candidates(path: Path) -> None:
    """Refuse a sensor with several candidate poses.

    Raises
    ------
    NoAnswerError
        If the file of candidates exists.
    """
    if path.exists():
        record = _read(path)
        raise NoAnswerError(record["message"], hint=record["hint"])


def calibrate_jointly(
    sensors: Mapping[str, Sequence[Path]], folder: Path, map_file: Path, road: Path, *,
    guesses: Mapping[str, Sequence[float]], clocks: Path | None, reporter: Reporter, **options: Any,
) -> Record:  # fmt: skip
    """Calibrate jointly those sensors of a site that have one or several candidate poses.

    Parameters
    ----------
    sensors : mapping of str to sequence of Path
        Recordings by sensor.
    folder : Path
        Holds the folders of the sensors.
    map_file, road : Path
        The lanes, and the scanned road.
    guesses : mapping of str to sequence of float
        Guess of each sensor, in the map's CRS.
    clocks : Path or None
        File of clocks' offsets, if they were measured.
    reporter : Reporter
        Receives progress and remarks.
    **options
        As for :func:`gis_radar.read_map`.

    Returns
    -------
    dict
        For each sensor its `pose`, or the `message` and `hint` of its refusal; and `line`, a text
        on what the adjustment gained, or why the sensor is not part of it.
    """
    candidates = {name: _own_candidates(folder / name) for name in sensors}
    poses = {name: found[0] for name, found in candidates.items() if found[0]}
    solved = calibration.Solved(poses={}, chosen={}, refused={}, pairs={})
    if poses:
        roads = hdmap.read_map(map_file, reporter=reporter, **options)
        points = scans.read_road(road, roads.crs)
    if len(poses) > 1:
        known = {} if clocks is None else calibration.read_clocks(clocks)
        solved = calibration.adjust_poses(
            {name: sensors[name] for name in poses}, poses, roads, points,
            clocks=known, reporter=reporter,
        )  # fmt: skip
    if poses:
        localize = partial(
            calibration.localize_one, roads=roads, road_points=points, reporter=SILENT
        )
        swapped = _swapped(sensors, poses, solved, guesses, localize)
        solved = replace(solved, refused={**solved.refused, **swapped})
    return {
        name: _sensor_record(name, found, solved, candidates[name][1])
        for name, found in poses.items()
    }  # fmt: skip


def _swapped(
    sensors: Mapping[str, Sequence[Path]], poses: Mapping[str, tuple[Pose, ...]],
    solved: calibration.Solved, guesses: Mapping[str, Sequence[float]],
    localize: Callable[..., Any],
) -> dict[str, Text]:  # fmt: skip
    """Return why sensors with a pose are refused whose guess is that of one without an answer."""
    alone = {name: found[0] for name, found in poses.items() if len(found) == 1}
    placed = {name: p for name, p in (alone | solved.poses).items() if name not in solved.refused}
    starts = {name: (paths[0], guesses[name]) for name, paths in sensors.items() if paths}
    reasons = calibration.swapped_guesses(placed, solved.pairs, starts, poses, localize)
    return {name: Text("{}: {}", name, reason) for name, reason in reasons.items()}


def _own_candidates(place: Path) -> tuple[tuple[Pose, ...], Record]:
    """Return the poses that a sensor may have by itself, and its refusal if these are several."""
    if (place / POSE_FILE).exists():
        return (read_pose(place / POSE_FILE),), {}
    if not (place / CANDIDATES_FILE).exists():
        return (), {}
    record = _read(place / CANDIDATES_FILE)
    what = str(place / CANDIDATES_FILE)
    return tuple(pose_from_dict(each, what=what) for each in record.pop("poses")), record


def _sensor_record(
    name: str, poses: tuple[Pose, ...], solved: calibration.Solved, refusal: Record
) -> Record:
    """Return the record of a sensor, as :func:`calibrate_jointly` returns it."""
    if name in solved.refused:
        return {
            "message": solved.refused[name],
            "hint": calibration.CLASH_HINT,
            "line": Text("refused"),
        }
    why = solved.unmatched.get(name, "no other sensor has a pose")
    if name not in solved.poses:
        if not refusal:
            return {"pose": poses[0].as_dict(), "line": Text("alone: {}", why)}
        return {**refusal, "line": Text("not placed: {}", why)}
    pose = solved.poses[name]
    if "together" not in pose.evidence:
        return {"pose": pose.as_dict(), "line": Text("alone: {}", why)}
    line = calibration.gain_line(pose)
    if refusal:
        why = Text(refusal["message"]).without(name)
        line = Text("{}; alone it was refused ({})", line, why)
    return {"pose": pose.as_dict(), "line": line}


def write_joint_poses(record: Record, path: Path) -> None:
    """Write the record of all sensors, from :func:`calibrate_jointly`."""
    _write(path, {"sensors": record})


def read_joint_pose(path: Path, sensor: str) -> tuple[Pose, str]:
    """Return the pose of a sensor, and the line about its adjustment.

    Raises
    ------
    NoAnswerError
        If it is refused.
    """
    entry = _read(path)["sensors"][sensor]
    if "pose" not in entry:
        raise NoAnswerError(entry["message"], hint=entry["hint"])
    return pose_from_dict(entry["pose"], what=f"{path}: {sensor}"), entry["line"]


def _write(path: Path, record: Record) -> None:
    with atomic_write(path) as part:
        part.write_text(json.dumps(with_texts(record), indent=1) + "\n", encoding="utf-8")


def _read(path: Path) -> Record:
    try:
        return restored(dict(read_json(path, what="the answer of a stage")))
    except (TypeError, ValueError) as error:
        raise InputError("{}: cannot be read", path, hint="run again with --fresh") from error
