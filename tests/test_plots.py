"""Plots by one call: on the axes given, with units, showing what they should."""

from __future__ import annotations

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import shapely
from matplotlib.colors import to_rgb
from test_cards import a_localization, a_pose, a_track
from test_heatmap import T0, lane_tiles, make_site

import gis_radar as gr
from gis_radar.calibration import Track
from gis_radar.products.heatmap import style
from gis_radar.products.heatmap.picture import STRIPE


@pytest.fixture(autouse=True)
def no_window():
    mpl.use("Agg")
    yield
    plt.close("all")


@pytest.fixture
def heat():
    """Tile 0 is hit in all of the first second and never after, tile 1 the other way round."""
    steps = set(range(T0, T0 + 40))
    hit = {(s, 0) for s in range(T0, T0 + 20)} | {(s, 1) for s in range(T0 + 20, T0 + 40)}
    site = make_site(lane_tiles(6), {("R1", "a"): steps}, {("R1", "a"): {0, 1, 2}}, hit)
    return gr.make_heatmap(site.dataset, interval="1s")


def colours(ax, tiles):
    """Return the colours that are drawn at the centres of tiles, darker stripes apart."""
    (image,) = ax.images
    west, east, south, north = image.get_extent()
    pixels = image.get_array()
    height, width, _ = pixels.shape
    found = []
    for centre in tiles.geometry.centroid:
        row = int((north - centre.y) / (north - south) * height)
        column = int((centre.x - west) / (east - west) * width)
        around = pixels[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3)
        shown, count = np.unique(around, axis=0, return_counts=True)
        found.append(tuple((shown[count.argmax()] / 255).round(3)))
    return found


def named(share):
    level = next(level for level in style.colour_classes() if share <= level.upper)
    return tuple(np.round(to_rgb(level.colour), 3))


def test_a_heat_map_is_drawn_on_the_axes_given(heat):
    figure, ax = plt.subplots()
    assert heat.plot(ax) is ax
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("easting, m", "northing, m")
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == [level.label for level in reversed(style.colour_classes())] + ["not observed"]
    assert plt.get_fignums() == [figure.number]


def test_a_heat_map_is_drawn_by_interval(heat):
    whole, first, last = (
        colours(heat.plot(interval=interval, legend=False), heat.tiles)
        for interval in (None, 0, -1)
    )
    assert whole.count(named(0.5)) == 2
    for drawn in (first, last):
        assert drawn.count(named(1.0)) == 1
        assert drawn.count(named(0.0)) == 2
        unseen = [tuple(np.round(to_rgb(each), 3)) for each in (style.NOT_OBSERVED, STRIPE)]
        assert sum(map(drawn.count, unseen)) == 3
    with pytest.raises(gr.UsageError, match="interval 2 of 2"):
        heat.plot(interval=2)


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


def test_a_localization_is_drawn_with_or_without_a_map():
    found = a_localization()
    roads = gr.read_map(gr.sample_folder() / "junction.osm")
    plain, whole = found.plot(), found.plot(roads, np.zeros((0, 3)))
    assert "97\u202f% of the vehicle paths lie on the lanes" in plain.get_title()
    drawn = np.vstack([c.get_offsets() for c in plain.collections[:2]])
    expected = found.pose.to_map(found.traces)[:, :2]
    assert sorted(drawn[:, 0]) == pytest.approx(sorted(expected[:, 0]))
    assert len(whole.collections) > len(plain.collections)


def test_a_track_is_drawn_component_by_component():
    track = Track(poses=a_track())
    ax = track.plot("yaw")
    assert ax.get_ylabel() == "yaw, deg"
    assert ax.lines[-1].get_ydata()[0] == pytest.approx(30.0)
    assert track.plot().get_ylabel() == "easting, m"
    with pytest.raises(gr.UsageError, match="component is 'x'"):
        track.plot("x")
