"""Where a picture puts its parts."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from counted_sites import lane_tiles, make_site
from matplotlib.patches import Polygon, Rectangle
from test_heatmap_occupancy import both_of

from gis_radar.base import step_of
from gis_radar.poses import Pose
from gis_radar.products import MapLabels, make_heatmap
from gis_radar.products.heatmap.figure import busiest_window, free_corner, heatmap_figure
from gis_radar.products.heatmap.intervals import HOUR
from gis_radar.products.heatmap.picture import (
    NARROW_IN,
    OVERLAY_IN,
    add_corner_scale,
    add_sensor,
    map_picture,
    round_length,
)

SITE = np.array([677_000.0, 5_403_000.0])
EXTENT = (SITE, SITE + [400.0, 300.0])


@pytest.mark.parametrize(
    ("longest", "chosen"), [(0.3, 0.2), (1.0, 1.0), (49.9, 20.0), (50.0, 50.0), (1234.0, 1000.0)]
)
def test_scale_bar_is_a_round_length(longest, chosen):
    assert round_length(longest) == pytest.approx(chosen)


def test_busiest_window_holds_the_busiest_tiles():
    rng = np.random.default_rng(2)
    centres = SITE + rng.uniform(0, [400, 300], (2000, 2))
    busy = SITE + [310.0, 80.0]
    near = np.abs(centres - busy).max(axis=1) < 10
    share = np.where(near, 0.5, 0.001)
    share[~near][:100] = np.nan
    low, high = busiest_window(centres, share, EXTENT)
    assert ((centres[near] >= low) & (centres[near] <= high)).all()
    assert (high - low).tolist() == pytest.approx([45.0, 45.0])


def test_no_window_for_small_or_quiet_maps():
    centres = SITE + [[5.0, 5.0]]
    assert busiest_window(centres, np.array([0.2]), (SITE, SITE + 100.0)) is None
    assert busiest_window(centres, np.array([0.0]), EXTENT) is None
    assert busiest_window(centres, np.array([np.nan]), EXTENT) is None


def test_free_corner_has_no_tile():
    everywhere = np.stack(np.meshgrid(np.arange(0, 400, 5.0), np.arange(0, 300, 5.0)), axis=-1)
    everywhere = everywhere.reshape(-1, 2)
    assert free_corner(SITE + everywhere, EXTENT) is None
    right = everywhere[everywhere[:, 0] > 200]
    left, bottom, width, height = free_corner(SITE + right, EXTENT)
    assert left + width < 0.5
    assert bottom > 0.5
    assert width * 400 == pytest.approx(height * 300)
    crowded = everywhere[
        ~((everywhere < [110.0, 400.0]) & (everywhere > [-1.0, 190.0])).all(axis=1)
    ]
    assert free_corner(SITE + crowded, EXTENT)[2] * 400 == pytest.approx(0.3 * 300)


@pytest.mark.parametrize(
    "title", ["", "Junction", "The junction of Main Street and the road to the northern station"]
)
def test_the_words_over_the_map_end_before_the_scale_bar(title):
    """Those of the day on which clocks are set back are longest, with two offsets."""
    begin = step_of(np.array([datetime(2025, 10, 25, 22, tzinfo=UTC).timestamp()]))[0]
    view = ("R1", "a")
    day = set(range(int(begin), int(begin) + 25 * HOUR, HOUR - 1))
    site = make_site(lane_tiles(2), {view: day}, {view: {0, 1}}, {(int(begin), 1)})
    labels = MapLabels(title=title, timezone="Europe/Berlin")
    figure = heatmap_figure(make_heatmap(site.dataset, labels=labels))
    bar = min(
        patch.get_window_extent().x0 for patch in figure.artists if isinstance(patch, Rectangle)
    )
    arrow = min(
        patch.get_window_extent().x0 for patch in figure.artists if isinstance(patch, Polygon)
    )
    ends = {text.get_text(): text.get_window_extent().x1 for text in figure.texts}
    assert [end < bar for words, end in ends.items() if "October" in words] == [True]
    assert ends[title or "Hit share heat map"] < arrow


@pytest.mark.parametrize("language", ["en", "de"])
def test_the_figures_beside_a_wide_map_end_above_the_words_below(language):
    tiles = lane_tiles(120, turn=0.0).iloc[:60]
    dataset, *_ = both_of(tiles)
    labels = MapLabels(sources=["Map: City of Example, CC BY 4.0"] * 3, language=language)
    figure = heatmap_figure(make_heatmap(dataset, labels=labels))
    wide, tall = figure.get_size_inches()
    assert wide > tall
    heights = [text.get_window_extent() for text in figure.texts]
    below = max(box.y1 for box in heights if box.y1 < figure.bbox.height / 2)
    assert min(text.get_window_extent().y0 for text in figure.axes[-1].texts) > below


@pytest.mark.parametrize("at", [(1.0, 50.0), (99.0, 50.0), (50.0, 1.0), (99.0, 1.0)])
def test_the_name_of_a_sensor_at_the_edge_is_whole(at):
    corners = np.array([[(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]])
    picture = map_picture(corners, (np.zeros(2), np.full(2, 100.0)), 40_000)
    pose = Pose(
        sensor="R3 east", crs="EPSG:25832", easting=at[0], northing=at[1], height=0.0,
        yaw=0.0, pitch=0.0, roll=0.0,
    )  # fmt: skip
    names = []
    for width_in in (OVERLAY_IN, NARROW_IN):
        figure, ax = picture.blank(width_in)
        add_sensor(ax, pose, add_corner_scale(figure, ax))
        box, held = ax.texts[0].get_window_extent(), ax.get_window_extent()
        names.append((box.x0 >= held.x0 - 1, box.x1 <= held.x1 + 1, box.y0 >= held.y0 - 1))
    assert names == [(True, True, True)] * 2


@pytest.mark.parametrize(("east", "is_left"), [(90.0, True), (10.0, False), (50.0, False)])
def test_the_scale_bar_stands_in_the_corner_with_less_road(east, is_left):
    corners = np.array([[(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]])
    picture = map_picture(corners, (np.zeros(2), np.full(2, 100.0)), 40_000)
    figure, ax = picture.blank()
    road = np.column_stack([np.full(100, east), np.arange(100.0)])
    box = add_corner_scale(figure, ax, road=road)
    assert (box.x0 < ax.get_window_extent().width / 3.0) == is_left


@pytest.mark.parametrize("width_in", [OVERLAY_IN, NARROW_IN])
def test_a_sensor_beside_the_scale_bar_and_its_name_are_not_under_its_ground(width_in):
    corners = np.array([[(0.0, 0.0), (100.0, 0.0), (100.0, 60.0), (0.0, 60.0)]])
    picture = map_picture(corners, (np.zeros(2), np.array([100.0, 60.0])), 40_000)
    for up in range(5, 55, 5):
        figure, ax = picture.blank(width_in)
        pose = Pose(
            sensor="R3", crs="EPSG:25832", easting=90.0, northing=float(up), height=0.0,
            yaw=0.0, pitch=0.0, roll=0.0,
        )  # fmt: skip
        taken = add_corner_scale(figure, ax, [pose])
        assert not taken.contains(*ax.transData.transform((90.0, up)))
        add_sensor(ax, pose, taken)
        assert not ax.texts[0].get_window_extent().overlaps(taken)
