"""What is wrong in silence is worst: inputs that cannot be are refused or named."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from datasets import measured
from maps import EAST, NORTH, Listener, write_osm, write_road
from pyproj import CRS

import gis_radar as gr
from gis_radar.base import CrsError, InputError
from gis_radar.products import write_projection

POSE = gr.Pose(
    sensor="R1", crs=gr.read_pose(gr.sample_folder() / "R1.json").crs, easting=EAST - 5.0,
    northing=NORTH, height=105.0, yaw=0.0, pitch=0.0, roll=0.0,
)  # fmt: skip


def table(frames=40, scale=1.0, x=30.0):
    time = np.repeat(1_700_000_000 + 0.05 * np.arange(frames), 3)
    number = np.arange(len(time), dtype=np.float32)
    return pd.DataFrame(
        {"time": time, "x": (x + number % 7) * scale, "y": 0.0, "z": -4.0 * scale,
         "range_rate": 0.0, "rcs": 5.0}
    ).astype(dict.fromkeys(("x", "y", "z", "range_rate", "rcs"), np.float32))  # fmt: skip


def recording(path, **options):
    table(**options).to_parquet(path)
    return path


@pytest.fixture(scope="module")
def tiles(tmp_path_factory):
    path = write_road(tmp_path_factory.mktemp("map") / "map.osm")
    return gr.make_tiles(gr.read_map(path))


# Recordings.


@pytest.mark.parametrize("unit", [1000.0, 300.0])
def test_a_recording_in_millimetres_is_refused(tmp_path, tiles, unit):
    path = recording(tmp_path / "R1.parquet", scale=unit)
    for use in (
        lambda: measured([path], [POSE], tiles, tmp_path / "o"),
        lambda: write_projection(path, POSE, tmp_path / "h.gpkg"),
    ):
        with pytest.raises(InputError, match=r"R1\.parquet: half of the .* beyond any radar"):
            use()


def test_some_far_detections_are_named_and_no_fault(tmp_path, tiles):
    """They may be in centimetres."""
    rows, heard = table(), Listener()
    rows.loc[::5, "x"] = 50_000.0
    rows.to_parquet(tmp_path / "R1.parquet")
    measured([tmp_path / "R1.parquet"], [POSE], tiles, tmp_path / "o", reporter=heard)
    assert "20.0% of the detections are over 1,514 m away" in str(heard.messages)


@pytest.mark.parametrize(("x", "named"), [(16.0, False), (300.0, True)])
def test_a_recording_without_a_hit_is_named(tmp_path, tiles, x, named):
    heard = Listener()
    path = recording(tmp_path / "R1.parquet", x=x)
    pose = replace(POSE, easting=EAST)
    measured([path], [pose], tiles, tmp_path / "o", reporter=heard)
    assert ("no detection of R1 lies on a tile" in str(heard.messages)) is named


@pytest.mark.parametrize(("azimuth_deg", "named"), [(120.0, False), (10.0, True)])
def test_a_view_that_leaves_detections_out_is_named(tmp_path, tiles, azimuth_deg, named):
    """Half an opening angle leaves out many."""
    rows, heard = table(), Listener()
    rows["y"] = np.where(np.arange(len(rows)) % 3, 4.0, 0.0)
    rows.to_parquet(tmp_path / "R1.parquet")
    pose = replace(POSE, view=replace(POSE.view or gr.View(), azimuth_deg=azimuth_deg))
    measured([tmp_path / "R1.parquet"], [pose], tiles, tmp_path / "o", reporter=heard)
    assert ("lie outside the view of R1 (azimuth 10" in str(heard.messages)) is named


def test_a_heat_map_of_zeros_is_named(tmp_path, tiles):
    path = recording(tmp_path / "R1.parquet", x=300.0)
    found = measured([path], [POSE], tiles, tmp_path / "o")
    heard = Listener()
    gr.make_heatmap(found, reporter=heard)
    assert "no tile was hit while it was observed" in str(heard.messages)


# Poses.


@pytest.mark.parametrize(
    ("easting", "northing"),
    [(11.5, 48.1), (EAST * 1000, NORTH * 1000), (NORTH, EAST)],
    ids=["degrees", "millimetres", "swapped"],
)
def test_detections_are_placed_by_poses_on_earth_only(tmp_path, easting, northing):
    pose = replace(POSE, easting=easting, northing=northing)
    path = recording(tmp_path / "R1.parquet")
    with pytest.raises(CrsError, match=r"pose of R1: .*far outside the area"):
        write_projection(path, pose, tmp_path / "h.gpkg")


@pytest.fixture
def track(tmp_path):
    views = gr.View()
    poses = tuple(replace(POSE, easting=EAST + k, view=views) for k in range(4))
    path = tmp_path / "track.csv"
    gr.PoseTrack(poses=poses, since=1.7e9 + np.arange(4.0)).write(path)
    return path


def test_a_track_that_is_cut_anywhere_in_its_last_row_is_refused(track):
    text = track.read_text()
    begin = text.rindex("\n", 0, -1) + 1
    assert len(gr.read_track(track).poses) == 4
    for end in range(begin + 1, len(text) - 1):
        track.write_text(text[:end])
        with pytest.raises(InputError, match=r"track\.csv: row 4 .*cut off|track\.csv: row 4"):
            gr.read_track(track)


@pytest.mark.parametrize("view", [None, gr.View()], ids=["no view", "view"])
def test_a_track_needs_no_line_end_at_its_end(tmp_path, view):
    """RFC 4180: "The last record in the file may or may not have an ending line break"."""
    poses = tuple(replace(POSE, easting=EAST + k, view=view) for k in range(2))
    path = tmp_path / "track.csv"
    gr.PoseTrack(poses=poses, since=1.7e9 + np.arange(2.0)).write(path)
    path.write_text(path.read_text().rstrip("\n"))
    assert gr.read_track(path).poses[1].easting == EAST + 1


@pytest.mark.parametrize("more", [",", ",1,2", ',"x"'])
def test_a_row_with_too_many_cells_is_refused(track, more):
    lines = track.read_text().splitlines()
    lines[2] += more
    track.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=r"track\.csv: row 2 has \d+ cells, the header"):
        gr.read_track(track)


def test_a_track_with_a_huge_cell_is_refused(track):
    track.write_text(track.read_text().replace("R1", "R" * 200_000, 1))
    with pytest.raises(InputError, match=r"track\.csv: not a pose track: field larger"):
        gr.read_track(track)


def test_a_track_of_ones_own_needs_no_last_line_end(tmp_path):
    head = "time,sensor,crs,easting,northing,height,yaw,pitch,roll"
    row = f"2023-11-14T22:13:20Z,R1,EPSG:25832,{EAST},{NORTH},5,0,0,0"
    (tmp_path / "t.csv").write_text(f"{head}\n{row}")
    assert gr.read_track(tmp_path / "t.csv").sensor == "R1"


# Maps.


def lane(path, *more, width=3.5, height="100"):
    """Two lanelets one after the other, the second `width` wide."""
    nodes, ways, lanelets = {}, {}, {}
    for k, (east, wide) in enumerate([(0.0, 3.5), (20.0, width), *more]):
        corners = {(10 * k + 1): (east, 0.0), (10 * k + 2): (east + 20.0, 0.0),
                   (10 * k + 3): (east, -wide), (10 * k + 4): (east + 20.0, -wide)}  # fmt: skip
        nodes |= {ref: (*xy, height) for ref, xy in corners.items()}
        ways |= {100 + 2 * k: [10 * k + 1, 10 * k + 2], 101 + 2 * k: [10 * k + 3, 10 * k + 4]}
        lanelets[1000 + k] = (100 + 2 * k, 101 + 2 * k, {"subtype": "road"})
    return write_osm(path, nodes, ways, lanelets)


@pytest.mark.parametrize(
    ("width", "action"), [(12.0, None), (101.0, "doubtful"), (9_000.0, "left out")]
)
def test_lanelets_of_impossible_width(tmp_path, width, action):
    roads = gr.read_map(lane(tmp_path / "m.osm", width=width))
    found = dict(zip(roads.problems["lanelet_id"], roads.problems["action"], strict=True))
    assert found == ({} if action is None else {1001: action})
    assert len(roads.lanelets) == (1 if action == "left out" else 2)
    if action:
        assert f"{width:.0f} m apart" in roads.problems["reason"].iloc[0]
        assert f"1 lanelet {action}" in str(roads.remarks)


@pytest.mark.parametrize("bound", [4, 3])  # along a bound, and across
@pytest.mark.parametrize(("height", "is_named"), [("0", True), ("104", False), ("1000", True)])
def test_a_height_that_jumps_is_named(tmp_path, bound, height, is_named):
    path = lane(tmp_path / "m.osm")
    at = f'<node id="{bound}"'
    before, _, after = path.read_text().partition(at)
    path.write_text(before + at + after.replace('v="100"', f'v="{height}"', 1))
    found = gr.read_map(path).problems
    assert found["lanelet_id"].tolist() == [1000] * is_named
    step = abs(int(height) - 100)
    assert all(f"its heights jump by {step} m" in each for each in found["reason"])


def test_a_stray_lanelet_is_left_out(tmp_path):
    roads = gr.read_map(lane(tmp_path / "m.osm", (150_000.0, 3.5)))
    assert set(roads.lanelets["lanelet_id"]) == {1000, 1001}
    assert "km from the middle of the map" in roads.problems["reason"].iloc[0]


def test_heights_that_are_no_numbers_are_named(tmp_path):
    roads = gr.read_map(lane(tmp_path / "m.osm", height="520 ft"))
    assert "heights of 8 nodes are not used: ele is no number of metres, such as '520 ft'" in str(
        roads.remarks
    )
    assert "heights" not in str(gr.read_map(lane(tmp_path / "n.osm", height="")).remarks)


def test_a_map_outside_its_zone_names_its_file_and_no_option(tmp_path, monkeypatch):
    path = write_road(tmp_path / "m.osm")
    monkeypatch.setattr("gis_radar.hdmap.positions.utm_zone", lambda *_: CRS.from_epsg(32755))
    with pytest.raises(CrsError, match=r"m\.osm: the site lies far outside") as caught:
        gr.read_map(path)
    assert "--crs" not in caught.value.message
    with pytest.raises(CrsError, match=r"m\.osm: the site lies far outside"):
        gr.read_map(path, crs=CRS.from_epsg(32755))  # as of tiles or of a road, not of the user
    with pytest.raises(CrsError, match="--crs: the site lies far outside"):
        gr.read_map(path, crs=32755)
