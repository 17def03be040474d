"""Where a picture puts its parts."""

from __future__ import annotations

import numpy as np
import pytest

from gis_radar.heatmap.figure import busiest_window, free_corner
from gis_radar.heatmap.picture import round_length

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
