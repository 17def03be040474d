"""The stages of a run as functions from files to files, each a call or two of the library.

Their arguments are paths and small settings, which any executor can send to a worker; options that
a stage does not use itself are passed to the library's function. Rooms load when a stage of a
worker uses them. Stages return figures by name.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from gis_radar import calibration, hdmap, products, scans
from gis_radar import dataset as dataset_room
from gis_radar import recordings as recording_room
from gis_radar.base import (
    SILENT,
    GisRadarError,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    atomic_write,
    name_of,
    read_json,
    restored,
    scratch_folder,
    with_texts,
)
from gis_radar.poses import COMPONENTS, Pose, PoseTrack, View, pose_from_dict, read_pose, read_track
from gis_radar.site.messages import error_in_site_words
from gis_radar.site.recipes import mask_scans, measure_site, split_map

STATE = ".gis-radar"
_SIGHTS = "sights"  # folder in STATE: a cache of the sights of poses
Figures = dict[str, Any]
Paths = Sequence[Path]


def mask_stage(*, map_file: Path, scans: Paths, outputs: Paths, **options: Any) -> Figures:
    """Mask the road out of the scans."""
    return mask_scans(scans, map_file, outputs[0], **options)[1]


def road_stage(*, road: Path, outputs: Paths, reporter: Reporter) -> Figures:
    """Copy a road that was masked before, after a check."""
    crs = scans.road_crs(road)
    points = scans.read_road(road, crs)
    with atomic_write(outputs[0]) as part:
        shutil.copyfile(road, part)
    reporter.progress("copying the road", 1, 1)
    return {"crs": name_of(crs), "cells": len(points)}


def tiles_stage(*, map_file: Path, outputs: Paths, **options: Any) -> Figures:
    """Split the lanes into tiles, at the heights of the scanned road if there is one."""
    return split_map(map_file, outputs[0], **options)


def convert_stage(*, recordings: Paths, outputs: Paths, **options: Any) -> Figures:
    """Convert the files of a sensor, of any known format, to one recording."""
    with scratch_folder() as folder:
        made = recording_room.convert(recordings, folder / outputs[0].name, **options)
        if len(made.outputs) != 1:
            names = ", ".join(str(each.sensor) for each in made.recordings)
            raise InputError(
                "{}: has several sensors: {}",
                recordings[0],
                names,
                hint="name one in [sensor.convert]: sensor = ...",
            )
        with atomic_write(outputs[0]) as part:
            shutil.move(made.outputs[0], part)
    return dict(made.figures())


def localize_stage(
    *, recordings: Paths, map_file: Path, road: Path, outputs: Paths, **options: Any
) -> Figures:
    """Find a pose from the first recording that gives one, and check it by whole scans.

    If several poses fit, all are written: other sensors may decide among them.
    """
    pose, picture, several = outputs
    for before in outputs:
        before.unlink(missing_ok=True)  # so that a pose and candidates never exist together
    try:
        found = calibration.localize(recordings, map_file, road, figure=picture, **options)
    except calibration.AmbiguousError as refusal:
        write_candidates(refusal, options["sensor"], several)
        return {"candidates": len(refusal.answers)}
    found.pose.write(pose)
    asked = max(n for n, path in enumerate(recordings, start=1) if path.name == found.recording)
    return {**found.figures(), "recording": found.recording, "asked": asked}


def together_stage(
    *, recordings: Paths, sensors: dict[str, int], map_file: Path, road: Path, outputs: Paths,
    reporter: Reporter, clocks: Path | None = None, **options: Any,
) -> Figures:  # fmt: skip
    """Calibrate sensors jointly, by the vehicles that they share.

    `recordings` lists those of all sensors, as many for each as `sensors` states; converted ones
    lie in the sensors' folders.
    """
    folder = outputs[0].parent / "sensors"
    paths = _by_sensor(recordings, sensors, folder)
    found = calibrate_jointly(
        paths, folder, map_file, road, clocks=clocks, reporter=reporter, **options
    )
    write_joint_poses(found, outputs[0])
    for name, entry in found.items():
        reporter.log(Text("{}: {}", name, entry["line"]))
    return {name: entry["line"] for name, entry in found.items()}


def _by_sensor(recordings: Paths, numbers: dict[str, int], folder: Path) -> dict[str, list[Path]]:
    """Return the recordings of each sensor: the next `numbers` of the list, and converted ones."""
    left, paths = list(recordings), {}
    for name, number in numbers.items():
        paths[name], left = left[:number], left[number:]
        if (converted := folder / name / RECORDING_FILE).exists():
            paths[name].append(converted)
    return paths


def tied_pose_stage(
    *, together: Path, outputs: Paths, reporter: Reporter, sensor: str,
    view: dict[str, float] | None,
) -> Figures:  # fmt: skip
    """Write the pose of a joint calibration, with the view of the site file."""
    pose, line = read_joint_pose(together, sensor)
    if view is not None:
        pose = replace(pose, view=View(**view))
    pose.write(outputs[0])
    reporter.progress("taking the pose", 1, 1)
    return {**_pose_figures(pose), "together": line}


def pose_stage(
    *, pose: Path, outputs: Paths, reporter: Reporter, sensor: str, view: dict[str, float] | None,
    given: bool, candidates: Path | None = None,
) -> Figures:  # fmt: skip
    """Write a pose or a pose track that was given or found, with the view of the site file.

    The view of a given pose comes before that of the site file. That of a found pose does not: it
    is only the range that its recording shows.
    """
    if candidates is not None:
        refuse_candidates(candidates)
    track = read_track(pose)
    track.poses[-1].plane_covariance()  # checked here, a bad one stops this sensor only
    if not given and view is not None:
        track = replace(track, poses=tuple(replace(p, view=View(**view)) for p in track.poses))
    elif given and track.sensor != sensor:
        reporter.log(Text("{}: is the pose of {}, taken for {}", pose, track.sensor, sensor))
    if given and track.has_other_view(view or {}):
        reporter.warn("the pose of {} has another view, which counts", sensor)
    if outputs[0].suffix == ".csv":
        with atomic_write(outputs[0]) as part:
            shutil.copyfile(pose, part)
        return {"poses": len(track.poses)}
    only = _named_with_view(track, sensor, view).poses[0]
    only.write(outputs[0])
    return _pose_figures(only)


def _pose_figures(pose: Pose) -> Figures:
    sigma = pose.parsed_evidence().sigma
    return {
        **{name: round(getattr(pose, name), 3) for name in COMPONENTS},
        **{f"sigma_{name}": float(f"{value:.2g}") for name, value in sigma.items()},
    }


def _named_with_view(track: PoseTrack, sensor: str, view: dict[str, float] | None) -> PoseTrack:
    """Return a track with the sensor's name of this site, and with `view` where it has none."""
    named = replace(track, poses=tuple(replace(each, sensor=sensor) for each in track.poses))
    return named if view is None else named.with_view(View(**view))


def measure_stage(
    *, recordings: Paths, poses: Paths, sensors: dict[str, dict[str, Any]], map_file: Path,
    tile_file: Path, outputs: Paths, reporter: Reporter, before_hour: int | None = None,
    **options: Any,
) -> Figures:  # fmt: skip
    """Measure the recordings of all sensors: make the site's dataset, or its missing hours.

    `recordings` lists those of all sensors, as many for each as `sensors` states; converted ones
    lie in the sensors' folders. Sensors without a pose or a recording are left out, as are those
    whose recordings are refused.
    """
    numbers = {name: each["recordings"] for name, each in sensors.items()}
    paths = _by_sensor(recordings, numbers, outputs[0].parent / "sensors")
    given = {
        name: (paths[name], _named_with_view(read_track(pose), name, sensors[name]["view"]))
        for pose in poses
        if paths[name := pose.parent.name]
    }
    cycles = {name: each["cycle"] for name, each in sensors.items() if each["cycle"]}
    made, refused = measure_site(
        given, tile_file, map_file, outputs[0], cycles=cycles, reporter=reporter,
        sight_cache=outputs[0].parent / STATE / _SIGHTS, before_hour=before_hour, **options,
    )  # fmt: skip
    heavy = {}
    if made.has_vehicles and before_hour is None:
        heavy = {"heavy": int((made.vehicles()["p_heavy"] >= 0.5).sum())}
    return {
        **made.figures(), **heavy,
        "doubts": {n: line for n, line in made.manifest.doubts.items() if n in made.sensors},
        "findings": _findings(made, refused),
        "refused": {name: error.message for name, error in refused.items()},
        "hints": {name: error.hint for name, error in refused.items()},
        "implausible": [n for n, error in refused.items() if isinstance(error, NoAnswerError)],
    }  # fmt: skip


def refusals_of(figures: Mapping[str, Any], timezone: str) -> dict[str, GisRadarError]:
    """Return the error of each sensor that :func:`measure_stage` has left out, by its figures."""
    refusals = dict[str, GisRadarError]()
    for name, why in figures.get("refused", {}).items():
        kind = NoAnswerError if name in figures.get("implausible", ()) else InputError
        error = kind(why, hint=figures.get("hints", {}).get(name, ""))
        refusals[name] = error_in_site_words(error, timezone)
    return refusals


def _findings(made: dataset_room.Dataset, refused: Mapping[str, GisRadarError]) -> Figures:
    """Return the findings of the plausibility check by sensor, also of those left out."""
    left_out = (each for each in refused.values() if isinstance(each, calibration.ImplausibleError))
    known = {name: made.manifest.checks.get(name) for name in made.sensors}
    return {name: found for name, found in known.items() if found} | {
        each.sensor: each.record for error in left_out for each in error.findings
    }


def heatmap_stage(
    *, dataset: Path, outputs: Paths, reporter: Reporter, labels: dict[str, Any], **options: Any
) -> Figures:
    """Make a heat map of the dataset."""
    zone = None if labels["timezone"] == "UTC" else labels["timezone"]
    heat = products.make_heatmap(
        dataset_room.open_dataset(dataset), timezone=zone, labels=products.MapLabels(**labels),
        reporter=reporter, **options,
    )  # fmt: skip
    heat.write(outputs[0], reporter=reporter)
    return heat.figures()


def project_stage(*, outputs: Paths, **options: Any) -> Figures:
    """Write sensors, sight and, if asked, vehicles as layers, and the project that shows them."""
    products.write_site_project(outputs[0].parent, **options)
    return {}


def report_stage(*, outputs: Paths, csv_locale: str, reporter: Reporter) -> Figures:
    """Write the report of all results; return its main figures."""
    made = products.write_report(outputs[0].parent, csv_locale=csv_locale, reporter=reporter)
    for remark in made.summary["found"]:
        reporter.log(remark)
    return {name: made.summary[name] for name in ("facts", "basis", "remarks")}


POSE_FILE, CANDIDATES_FILE, RECORDING_FILE = (
    "localization.json",
    "candidates.json",
    "recording.parquet",
)
Record = dict[str, Any]


def write_candidates(refusal: calibration.AmbiguousError, sensor: str, path: Path) -> None:
    """Write the candidate poses of a sensor, and the reason why it is refused alone."""
    poses = [replace(each.pose, sensor=sensor).as_dict() for each in refusal.answers]
    _write_answer(path, {"message": refusal.message, "hint": refusal.hint, "poses": poses})


def refuse_candidates(path: Path) -> None:
    """Refuse a sensor with several candidate poses.

    Raises
    ------
    NoAnswerError
        If the file of candidates exists.
    """
    if path.exists():
        record = _read_answer(path)
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
    record = _read_answer(place / CANDIDATES_FILE)
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
    _write_answer(path, {"sensors": record})


def read_joint_pose(path: Path, sensor: str) -> tuple[Pose, str]:
    """Return the pose of a sensor, and the line about its adjustment.

    Raises
    ------
    NoAnswerError
        If it is refused.
    """
    entry = _read_answer(path)["sensors"][sensor]
    if "pose" not in entry:
        raise NoAnswerError(entry["message"], hint=entry["hint"])
    return pose_from_dict(entry["pose"], what=f"{path}: {sensor}"), entry["line"]


def _write_answer(path: Path, record: Record) -> None:
    with atomic_write(path) as part:
        part.write_text(json.dumps(with_texts(record), indent=1) + "\n", encoding="utf-8")


def _read_answer(path: Path) -> Record:
    try:
        return restored(dict(read_json(path, what="the answer of a stage")))
    except (TypeError, ValueError) as error:
        raise InputError("{}: cannot be read", path, hint="run again with --fresh") from error
