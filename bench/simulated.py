"""Simulated sites with known poses: the sample junction, and others that lie beside the project."""

from __future__ import annotations

import json
from pathlib import Path

from pyproj import CRS

import gis_radar as gr

ROOT = Path(__file__).parent.parent
FIELDS = ("easting", "northing", "height", "yaw", "pitch", "roll")


def sites() -> list[Path]:
    """Return the folders of all sites that are there."""
    data = ROOT.parent / "shared" / "data"
    return [gr.sample_folder(), *(data / t for t in ("town02", "town04") if (data / t).exists())]


def true_pose(site: Path, sensor: str) -> gr.Pose:
    """Return where a sensor of a site truly stands and looks."""
    if (site / f"{sensor}.json").exists():
        return gr.read_pose(site / f"{sensor}.json")
    truth = json.loads((site / "truth.json").read_text())[sensor]
    view = gr.View(max_range_m=200.0)
    fields = {name: truth[name] for name in FIELDS}
    return gr.Pose(sensor=sensor, crs=CRS.from_epsg(25832), view=view, **fields)
