"""Simulated sites with known poses: the sample junction, and towns in ../shared/data.

The towns are no part of the project: where that folder is missing, benches run on the sample alone.
"""

from __future__ import annotations

import json
from pathlib import Path

from figures import ROOT
from pyproj import CRS

import gis_radar as gr

DATA = ROOT.parent / "shared" / "data"
POSE_FIELDS = ("easting", "northing", "height", "yaw", "pitch", "roll")


def sites(*names: str) -> list[Path]:
    """Return the folders of the sample and of those named towns that are there."""
    there = [DATA / name for name in names or ("town02", "town04")]
    return [gr.sample_folder(), *(each for each in there if each.exists())]


def true_pose(site: Path, sensor: str) -> gr.Pose:
    """Return the true pose of a sensor of a site."""
    if (site / f"{sensor}.json").exists():
        return gr.read_pose(site / f"{sensor}.json")
    truth = json.loads((site / "truth.json").read_text())[sensor]
    view = gr.View(max_range_m=200.0)
    fields = {name: truth[name] for name in POSE_FIELDS}
    return gr.Pose(sensor=sensor, crs=CRS.from_epsg(25832), view=view, **fields)
