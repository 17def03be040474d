"""The search for vehicles, on the sample: whole, cut, and with inputs that do not fit."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from maps import Listener
from pyproj import CRS

import gis_radar as gr
from gis_radar.tracking import hour_blocks
from gis_radar.tracking.batches import joined_rows
from gis_radar.tracking.map_check import describe_map

SAMPLE = gr.sample_folder()


SECONDS = 18.0  # of the sample's hundred: enough traffic


def begin_of(path, seconds=SECONDS):
    """Read the first seconds of a recording of the sample."""
    table = pd.read_parquet(path)
    return table[table["time"] < table["time"].iloc[0] + seconds]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    roads = gr.read_map(SAMPLE / "junction.osm")
    folder = tmp_path_factory.mktemp("vehicles")
    for name in ("R1", "R2"):
        begin_of(SAMPLE / f"{name}.parquet").to_parquet(folder / f"{name}.parquet", index=False)
    tiles = gr.make_tiles(roads)
    gr.write_tiles(tiles, folder / "tiles.gpkg", problems=roads.problems)
    return tiles, folder


def found(site, name, recordings=None, **options):
    tiles, folder = site
    given = recordings or [folder / "R1.parquet", folder / "R2.parquet"]
    poses = [gr.read_pose(SAMPLE / f"{path.stem[:2]}.json") for path in given]
    options = {"check": False} | options  # that poses fit is tested elsewhere
    return gr.measure(given, poses, tiles, SAMPLE / "junction.osm", folder / name, **options)


@pytest.fixture(scope="module")
def whole(site, once):
    def search(folder):
        found(site, folder / "whole")
        return folder / "whole"

    return gr.open_dataset(once("vehicles of the sample", search))


def occupied_s(ds, tiles):
    runs, seconds = ds.occupied(), np.zeros(len(tiles))
    np.add.at(seconds, runs["tile_id"], (runs["end"] - runs["begin"]).dt.total_seconds())
    return seconds


def steps_of(tracks):
    return (tracks["time"].astype("datetime64[us, UTC]").astype("int64") // 50_000).to_numpy()


def moving_detections():
    """Return time, easting and northing of all moving detections of the sample's begin."""
    parts = []
    for name in ("R1", "R2"):
        table = begin_of(SAMPLE / f"{name}.parquet")
        table = table[table["range_rate"].abs() > 0.5]
        points = gr.read_pose(SAMPLE / f"{name}.json").to_map(table[["x", "y", "z"]].to_numpy())
        parts.append(np.column_stack([table["time"], points[:, :2]]))
    return np.vstack(parts)


def test_most_moving_vehicles_near_the_sensors_are_followed(whole):
    truth = pd.read_parquet(SAMPLE / "vehicles.parquet")
    truth = truth[truth["t"] < truth["t"].iloc[0] + SECONDS]
    eyes = [gr.read_pose(SAMPLE / f"{name}.json").position[:2] for name in ("R1", "R2")]
    places = truth[["easting", "northing"]].to_numpy()
    near = np.min([np.hypot(*(places - eye).T) for eye in eyes], axis=0) < 80.0
    of_states = (truth["t"] * 20).round() % 4 == 0
    vehicle = ~truth["kind"].isin(["walker", "cyclist"])
    rows = truth[near & vehicle & (truth["speed"] > 3.0) & of_states].iloc[::5]
    tracks = whole.tracks()
    by_step = dict(iter(tracks.groupby(steps_of(tracks))))
    seen = moving_detections()
    hit, detected = [], []
    for row in rows.itertuples():
        place = np.array([row.easting, row.northing])
        now = seen[np.abs(seen[:, 0] - row.t) < 0.25, 1:]
        # else it is behind a house, or missed by both
        detected.append((np.hypot(*(now - place).T) < 0.5 * row.length + 1.0).sum() >= 3)
        at = by_step.get(round(row.t * 20))
        apart = np.inf if at is None else np.hypot(
            at["easting"] - row.easting, at["northing"] - row.northing
        ).min()  # fmt: skip
        hit.append(apart < 4.0)
    assert sum(detected) > 100
    assert np.mean(hit) > 0.7
    assert np.mean(np.array(hit)[detected]) > 0.85


def test_blocks_neither_lose_nor_double_occupancy(site, whole, monkeypatch):
    monkeypatch.setattr(hour_blocks, "BLOCK_STEPS", 300)
    monkeypatch.setattr(hour_blocks, "BLOCK_MARGIN_STEPS", 100)
    cut = found(site, "cut")
    tiles, _ = site
    uncut, in_blocks = occupied_s(whole, tiles), occupied_s(cut, tiles)
    assert in_blocks.sum() == pytest.approx(uncut.sum(), rel=0.1)
    assert np.corrcoef(in_blocks, uncut)[0, 1] > 0.9
    assert len(cut.vehicles()) < 1.3 * len(whole.vehicles())


def test_frames_missing_around_the_edge_of_a_block_part_no_vehicle(site, tmp_path, monkeypatch):
    table = begin_of(SAMPLE / "R1.parquet")
    step = (table["time"] * 20.0).round().astype(int)
    edge, gap = -(-int(step.min()) // 240) * 240, 12
    near = abs(step - edge)
    kept = table[(near < 100) & (near > gap)]
    kept.to_parquet(tmp_path / "R1.parquet", index=False)
    states = []
    monkeypatch.setattr(hour_blocks, "BLOCK_MARGIN_STEPS", 240)
    for name, steps in (("gap-whole", 6000), ("gap-cut", 240)):
        monkeypatch.setattr(hour_blocks, "BLOCK_STEPS", steps)
        made = found(site, name, [tmp_path / "R1.parquet"])
        tracks = made.tracks()
        step = steps_of(tracks)
        states.append(tracks[(abs(step - edge) <= gap) & (step % 4 == 0)])
    whole, cut = (each.groupby("vehicle").size() for each in states)
    through = 2 * gap // 4 + 1  # states
    assert (whole == through).sum() > 3
    assert (cut == through).sum() == (whole == through).sum()
    assert len(states[1]) == pytest.approx(len(states[0]), rel=0.05)


def test_where_nothing_moves_occupancy_is_zero_with_a_warning(site, tmp_path):
    table = begin_of(SAMPLE / "R1.parquet", 10.0)
    still = table[table["range_rate"].abs() < 0.05]
    still.to_parquet(tmp_path / "R1.parquet", index=False)
    heard = Listener()
    none = found(site, "still", [tmp_path / "R1.parquet"], reporter=heard)
    assert len(none.vehicles()) == 0
    assert any("occupancy is zero" in text for rank, text in heard.messages if rank == "warning")


def test_a_quiet_recording_has_occupancy_zero(site, tmp_path, run):
    columns = dict.fromkeys(["x", "y", "z", "range_rate", "rcs"], np.float32(np.nan))
    quiet = pd.DataFrame({"time": 1.7e9 + 0.05 * np.arange(200)}).assign(**columns)
    quiet.to_parquet(tmp_path / "R1.parquet", index=False)
    code, out, _ = run(
        "measure", tmp_path / "R1.parquet", "--pose", SAMPLE / "R1.json", "--tiles",
        site[1] / "tiles.gpkg", "--map", SAMPLE / "junction.osm", "-o", tmp_path / "v", "--json",
    )  # fmt: skip
    assert code == 0
    assert "no vehicle moves in these recordings: the occupancy is zero" in out
    made = gr.open_dataset(tmp_path / "v")
    assert occupied_s(made, site[0]).sum() == 0.0
    assert len(made.visible()) > 0


def test_a_pose_in_another_system_than_the_tiles_is_refused(site):
    pose = replace(gr.read_pose(SAMPLE / "R1.json"), crs=CRS(32632))
    given = [site[1] / "R1.parquet"], [pose], site[0], SAMPLE / "junction.osm"
    with pytest.raises(gr.CrsError, match="the pose of R1 is in EPSG:32632, but the tiles in"):
        gr.measure(*given, site[1] / "other-crs")


def test_another_map_is_refused(site, tmp_path):
    tiles, folder = site
    pose = gr.read_pose(SAMPLE / "R1.json")
    other = (SAMPLE / "junction.osm").read_text().replace("<relation id='", "<relation id='9")
    other = other.replace('<relation id="', '<relation id="9')
    (tmp_path / "other.osm").write_text(other)
    with pytest.raises(gr.InputError, match="of the tiles"):
        gr.measure([SAMPLE / "R1.parquet"], [pose], tiles, tmp_path / "other.osm", folder / "other")
    (tmp_path / "other.osm").write_text(other.replace('lat="48.', 'lat="-35.'))
    with pytest.raises(gr.InputError, match=r"other\.osm: the site lies far outside the area"):
        gr.measure([SAMPLE / "R1.parquet"], [pose], tiles, tmp_path / "other.osm", folder / "other")


def test_the_map_of_the_tiles_is_told_from_others():
    path = SAMPLE / "junction.osm"
    roads = gr.read_map(path)
    tiles = gr.make_tiles(roads)
    known = describe_map(path, roads, tiles, origin=(1, 2))
    assert (known["crs"], known["origin"], len(known["digest"])) == ("EPSG:25832", [1.0, 2.0], 32)
    with pytest.raises(gr.InputError, match=r"junction\.osm: lacks lanelet 5 of the tiles"):
        describe_map(path, roads, tiles.assign(lanelet_id=5))
    tiles.geometry = tiles.geometry.translate(0.0, 0.3)
    with pytest.raises(gr.InputError, match=r"lanelet \d+ lies 0\.30 m from its tiles"):
        describe_map(path, roads, tiles)


def test_lanelets_of_two_parts_of_a_vehicle_follow_each_other():
    row = {"length_sigma_m": 0.3, "first_step": 1, "last_step": 2}
    one = row | {"lanelets": np.array([4, 7, 8]), "length_m": 4.0}
    other = row | {"lanelets": np.array([7, 8, 9]), "length_m": 5.0, "length_sigma_m": 0.1}
    joined = joined_rows(one, other)
    assert joined["lanelets"].tolist() == [4, 7, 8, 9]
    assert joined["length_m"] == 5.0
