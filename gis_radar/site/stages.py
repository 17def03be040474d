"""The stages of a run as functions from files to files, each a call or two of the library.

Their arguments are paths and small settings, which any executor can send to a worker; options that
a stage does not use itself are passed to the library's function. Rooms load when a stage of a
worker uses them. Stages return figures by name.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gis_radar import calibration, products, scans
from gis_radar import dataset as dataset_room
from gis_radar import recordings as recording_room
from gis_radar.base import (
    GisRadarError,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    atomic_write,
    name_of,
    scratch_folder,
)
from gis_radar.poses import COMPONENTS, Pose, PoseTrack, View, read_track
from gis_radar.site.joint_poses import (
    RECORDING_FILE,
    calibrate_jointly,
    read_joint_pose,
    refuse_candidates,
    write_candidates,
    write_joint_poses,
)
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


def lanes_stage(*, outputs: Paths, **of_lanes: Any) -> Figures:
    """Write names, streets and free speeds of lanes, as the site file states, into the dataset."""
    dataset_room.open_dataset(outputs[0].parent).state_lanes(**of_lanes)
    return {}


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
