"""Public names of version 0.1 that went: they work on, with a warning that says what to use."""

import numpy as np
import pytest
from sites import START, crossing, pose, recording

import gis_radar as gr
from gis_radar.earlier import MOVED, REPLACED


@pytest.mark.parametrize("name", [*MOVED, *REPLACED])
def test_an_earlier_name_is_found_with_a_warning(name):
    with pytest.warns(DeprecationWarning, match=rf"gis_radar\.{name} of version 0\.1") as caught:
        found = getattr(gr, name)
    assert callable(found)
    assert caught[0].filename == __file__
    assert name not in gr.__all__
    assert name not in dir(gr)


def test_a_name_that_never_was_is_an_error_as_ever():
    with pytest.raises(AttributeError, match="no_such_name"):
        gr.no_such_name  # noqa: B018
    assert not hasattr(gr, "__wrapped__")  # as what inspects modules asks


def test_the_earlier_way_to_xarray_gives_the_same(tmp_path):
    pytest.importorskip("xarray")
    points = [[10.0, 0.0, -4.5], [12.0, 0.0, -4.5], [14.0, 0.0, -4.5]]
    recording(tmp_path / "R1.parquet", START + 0.05 * np.arange(3), np.array(points))
    tiles = crossing()
    occupancy = gr.measure_occupancy([tmp_path / "R1.parquet"], [pose()], tiles, tmp_path / "occ")
    with pytest.warns(DeprecationWarning, match="make_heatmap"):
        cube = gr.to_xarray(occupancy, tiles, interval="50ms", tile_ids=tiles["tile_id"][:20])
    now = gr.make_heatmap(occupancy, tiles, interval="50ms", tile_ids=tiles["tile_id"][:20])
    assert cube.identical(now.to_xarray())


def test_an_earlier_argument_works_with_a_warning(tmp_path):
    with (
        pytest.warns(DeprecationWarning, match="use timezone=") as caught,
        pytest.raises(gr.GisRadarError, match="no such file"),
    ):
        gr.write_qgis_project(tmp_path / "a.qgz", heatmap=tmp_path, time_zone="Europe/Berlin")
    assert caught[0].filename == __file__
    both = {"time_zone": "UTC", "timezone": "UTC"}
    with pytest.raises(TypeError, match="both timezone and time_zone"):
        gr.write_qgis_project(tmp_path / "a.qgz", heatmap=tmp_path, **both)
