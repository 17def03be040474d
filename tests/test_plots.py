"""Plots by one call: on the axes given, with units, showing what they should."""

from __future__ import annotations

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import shapely
from test_cards import a_pose, a_track

import gis_radar as gr
from gis_radar.calibration import Track


@pytest.fixture(autouse=True)
def no_window():
    mpl.use("Agg")
    yield
    plt.close("all")


def test_a_pose_is_drawn_with_view_arrow_and_ellipse():
    pose = a_pose()
    ax = pose.plot(reach_m=50.0)
    area = shapely.Polygon(ax.patches[0].get_xy())
    assert area.area == pytest.approx(np.pi * 50.0**2 / 3, rel=0.01)
    east, north = pose.position[:2]
    tip = ax.texts[0].xy
    assert np.degrees(np.arctan2(tip[1] - north, tip[0] - east)) == pytest.approx(30.0, abs=0.2)
    ring = shapely.Polygon(ax.lines[0].get_xydata())
    assert ring.area == pytest.approx(np.pi * 5.991 * 0.25**2, rel=0.01)
    bare = gr.Pose(**{**vars(pose), "evidence": {}})
    assert len(bare.plot().lines) == 0


def test_a_track_is_drawn_component_by_component():
    track = Track(poses=a_track())
    ax = track.plot("yaw")
    assert ax.get_ylabel() == "yaw, deg"
    assert ax.lines[-1].get_ydata()[0] == pytest.approx(30.0)
    assert track.plot().get_ylabel() == "easting, m"
    with pytest.raises(gr.UsageError, match="component is 'x'"):
        track.plot("x")
