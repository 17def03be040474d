"""The whole way on the sample junction, and how near the poses that it finds are to the truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from gis_radar import site
from gis_radar.base import QUIET, Reporter
from gis_radar.poses import ANGLES, Pose, read_pose
from gis_radar.sample import sample_folder


def run_demo(
    folder: str | Path, *, reporter: Reporter = QUIET
) -> tuple[list[Path], dict[str, Any]]:
    """Run the sample site, whose sensors must find their poses, and compare these with the truth.

    Parameters
    ----------
    folder : str or Path
        Where the results of :func:`gis_radar.run_site` go, among them the QGIS project `site.qgz`.
    reporter : Reporter
        Receives progress and remarks.

    Returns
    -------
    outputs : list of Path
        What was written.
    figures : dict
        Figures worth a look, among them the errors of the poses.
    """
    sample, folder = sample_folder(), Path(folder)
    done = site.run_site(sample / "SITE.toml", folder, reporter=reporter)
    if done.failure is not None:
        raise done.failure
    errors = {
        sensor.name: pose_errors(
            read_pose(folder / "sensors" / sensor.name / "pose.json"),
            read_pose(sample / f"{sensor.name}.json"),
        )
        for sensor in done.site.sensor
    }
    return done.outputs, {**done.figures(), "errors_of_the_poses": errors}


def pose_errors(found: Pose, true: Pose) -> dict[str, float]:
    """Return how far a pose is from the true one.

    Returns
    -------
    dict
        `2D_m` the distance on the map, `height_m`, and `yaw_deg`, `pitch_deg`, `roll_deg` in
        (-180, 180]; found less true.
    """
    flat_m = math.hypot(found.easting - true.easting, found.northing - true.northing)
    turned = {
        f"{name}_deg": 180.0 - (180.0 - getattr(found, name) + getattr(true, name)) % 360.0
        for name in ANGLES
    }
    errors = {"2D_m": flat_m, "height_m": found.height - true.height, **turned}
    return {name: round(value, 3) for name, value in errors.items()}
