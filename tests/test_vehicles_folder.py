"""The folder of vehicles: its tables, streamed writing, refusals."""

import json
from itertools import pairwise

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import gis_radar as gr
from gis_radar.errors import InputError
from gis_radar.tiles import fingerprint
from gis_radar.tiles.tiles import polygons
from gis_radar.vehicles import read_vehicles
from gis_radar.vehicles.folder import VehiclePiece, write_vehicles
from gis_radar.vehicles.map_check import describe_map
from gis_radar.vehicles.provenance import Provenance
from gis_radar.vehicles.tables import TRACKS, VEHICLES
from gis_radar.vehicles.visibility import SensorView

FIRST = 34_000_000_000


# of a sensor at the origin
POSE = dict.fromkeys(("easting", "northing", "yaw", "pitch", "roll"), 0.0) | {
    "sensor": "R1", "crs": "EPSG:25832", "height": 5.0
}  # fmt: skip


def straight_tiles(count=40, *, length=0.5, width=3.0, lanelet_id=7, height=np.nan):
    """Lay the tiles of a lanelet that goes east from (0, 0)."""
    x = np.arange(count) * length
    ahead = np.array([length, 0.0])
    right, left = (np.column_stack([x, np.full(count, side)]) for side in (-width / 2, width / 2))
    return gpd.GeoDataFrame(
        {
            "tile_id": np.arange(count),
            "lanelet_id": lanelet_id,
            "index": np.arange(count),
            "s_m": x,
            "length_m": length,
            "width_m": width,
            "height_m": height,
            "subtype": "road",
        },
        geometry=polygons(np.stack([right, right + ahead, left + ahead, left], axis=1)),
        crs="EPSG:25832",
    )


def drive(vehicle, first_step, fronts, *, speed=10.0, lanelet_id=7, length=4.5, seen=True):
    """Give the states of a vehicle that goes east, its front at x = fronts."""
    fronts = np.asarray(fronts, float)
    return pd.DataFrame(
        {
            "vehicle": vehicle,
            "step": first_step + np.arange(len(fronts)),
            "easting": fronts - length / 2,
            "northing": 0.0,
            "heading": 0.0,
            "speed": speed,
            "lanelet_id": pd.array([lanelet_id] * len(fronts), dtype="Int64"),
            "s_m": fronts,
            "d_m": 0.0,
            "seen": seen,
        }
    )


def rows_of(tracks, *, length=4.5, width=1.8, p_heavy=0.0, sigma=0.3, continues=False):
    """Give the rows of the vehicles of some states."""
    by = tracks.groupby("vehicle")["step"].agg(["min", "max"])
    lanelets = [
        tracks.loc[tracks["vehicle"] == n, "lanelet_id"].dropna().unique().tolist()
        for n in by.index
    ]
    return pd.DataFrame(
        {
            "vehicle": by.index,
            "first_step": by["min"],
            "last_step": by["max"],
            "length_m": length,
            "width_m": width,
            "length_sigma_m": sigma,
            "p_heavy": p_heavy,
            "lanelets": lanelets,
            "continues": continues,
        }
    )


def frames_of_span(first, last, view="v"):
    return pd.DataFrame(
        {"sensor": ["R1"], "view": [view], "first_step": [first], "last_step": [last]}
    )


def provenance_of(tiles, **changed):
    known = {
        "fingerprint": fingerprint(tiles),
        "map": {"digest": "d", "crs": "EPSG:25832", "origin": None},
        "hold_s": {"R1": 0.1},
        "sources": [{"recording": "a", "rows": 10, "sensor": "R1", "poses": [POSE]}],
    }
    return Provenance(**(known | changed))


def view_of(tiles, position=(-20.0, 0.0, 6.0)):
    ids = tiles["tile_id"].to_numpy(np.int64)
    return SensorView(sensor="R1", view="v", tile_id=ids, position=np.array(position))


def write(folder, tiles, tracks, cuts=(), *, last=None, frames=None, warm_up=None, **options):
    """Write tracks in pieces that end before the cuts."""
    last = int(tracks["step"].max()) if last is None else last
    first = int(min(tracks["step"].min(), last))
    edges = [first, *cuts, last + 1]
    tracks = tracks.sort_values(["step", "vehicle"], ignore_index=True)
    rows = rows_of(tracks, **options)
    frames = frames_of_span(first, last) if frames is None else frames
    with write_vehicles(
        folder, tiles=tiles, views=[view_of(tiles)], provenance=provenance_of(tiles)
    ) as writer:
        if warm_up is not None:
            writer.warm_up(warm_up)
        for begin, after in pairwise(edges):
            part = tracks[tracks["step"].between(begin, after - 1)]
            here = frames.assign(
                first_step=frames["first_step"].clip(lower=begin),
                last_step=frames["last_step"].clip(upper=after - 1),
            )
            writer.add(
                VehiclePiece(
                    first_step=begin, last_step=after - 1, tracks=part,
                    vehicles=rows[rows["vehicle"].isin(part["vehicle"])],
                    frames=here[here["first_step"] <= here["last_step"]],
                )
            )  # fmt: skip
    return read_vehicles(folder)


def test_what_is_written_is_read(tmp_path):
    tiles = straight_tiles()
    tracks = pd.concat(
        [drive(3, FIRST, np.arange(20.0)), drive(1, FIRST + 5, np.arange(9.0), lanelet_id=None)]
    )
    found = write(tmp_path / "v", tiles, tracks)
    assert found.sensors == ["R1"]
    assert found.figures()["vehicles"] == 2
    read = pd.concat(found.tracks())
    expected = TRACKS.typed(tracks.sort_values(["step", "vehicle"], ignore_index=True))
    pd.testing.assert_frame_equal(read, expected)
    pd.testing.assert_frame_equal(found.vehicles, VEHICLES.typed(rows_of(tracks)))


def test_the_map_of_the_tiles_is_told_from_others():
    path = gr.sample_folder() / "junction.osm"
    roads = gr.read_map(path)
    tiles = gr.make_tiles(roads)
    known = describe_map(path, roads, tiles, origin=(1, 2))
    assert (known["crs"], known["origin"], len(known["digest"])) == ("EPSG:25832", [1.0, 2.0], 32)
    with pytest.raises(InputError, match=r"junction\.osm: lacks lanelet 5 of the tiles"):
        describe_map(path, roads, tiles.assign(lanelet_id=5))
    tiles.geometry = tiles.geometry.translate(0.0, 0.3)
    with pytest.raises(InputError, match=r"lanelet \d+ lies 0\.30 m from its tiles"):
        describe_map(path, roads, tiles)


@pytest.mark.parametrize("cuts", [(7,), (1, 2, 11)])
def test_the_folder_does_not_depend_on_the_pieces(tmp_path, cuts):
    tiles = straight_tiles()
    tracks = pd.concat([drive(3, FIRST, np.arange(20.0)), drive(1, FIRST + 5, np.arange(9.0))])
    write(tmp_path / "whole", tiles, tracks)
    write(tmp_path / "cut", tiles, tracks, [FIRST + cut for cut in cuts])
    for path in sorted((tmp_path / "whole").iterdir()):
        assert path.read_bytes() == (tmp_path / "cut" / path.name).read_bytes(), path.name


def test_a_slow_frame_before_the_edge_of_a_piece_covers_up_to_the_edge(tmp_path):
    tiles, tracks = straight_tiles(), drive(3, FIRST, np.arange(21.0))
    slow = pd.concat([frames_of_span(step, step) for step in range(FIRST, FIRST + 21, 2)])
    whole = write(tmp_path / "whole", tiles, tracks, frames=slow)
    write(tmp_path / "cut", tiles, tracks, [FIRST + 8, FIRST + 12], frames=slow)
    assert (next(whole.blocks()).visible["last_step"] == FIRST + 20).all()
    for name in ("visible.parquet", "frames.parquet", "passages.parquet"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="s_m"), "tracks: lacks the column s_m"),
        (lambda t: t.iloc[::-1], "tracks: rows do not ascend by step, vehicle"),
        (lambda t: t.drop(index=4), "tracks: vehicle 3 lacks a step from"),
        (lambda t: t.assign(speed=np.nan), "tracks: speed is empty in row 0"),
        (lambda t: t.assign(vehicle=0.5), "tracks: vehicle holds something else than int64"),
        (lambda t: t.assign(vehicle=4), "tracks: has states of a vehicle that the vehicles lack"),
    ],
)
def test_states_that_are_not_in_order_are_refused(tmp_path, change, message):
    tiles = straight_tiles()
    tracks = drive(3, FIRST, np.arange(10.0))
    piece = VehiclePiece(
        first_step=FIRST, last_step=FIRST + 9, tracks=change(tracks), vehicles=rows_of(tracks),
        frames=frames_of_span(FIRST, FIRST + 9),
    )  # fmt: skip
    writing = write_vehicles(
        tmp_path / "v", tiles=tiles, views=[view_of(tiles)], provenance=provenance_of(tiles)
    )
    with pytest.raises(InputError, match=message), writing as writer:
        writer.add(piece)
    assert not (tmp_path / "v").exists()


def test_frames_of_an_unknown_view_are_refused(tmp_path):
    tiles, tracks = straight_tiles(), drive(3, FIRST, np.arange(10.0))
    given = provenance_of(tiles)
    piece = VehiclePiece(
        first_step=FIRST, last_step=FIRST + 9, tracks=tracks, vehicles=rows_of(tracks),
        frames=frames_of_span(FIRST, FIRST + 9, view="other"),
    )  # fmt: skip
    writing = write_vehicles(tmp_path / "v", tiles=tiles, views=[view_of(tiles)], provenance=given)
    with pytest.raises(InputError, match="name the view other of R1, which is"), writing as one:
        one.add(piece)
    assert given.settings == {}  # inputs stay as they are


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"hold_s": None}, "damaged"),
        ({"hold_s": {}}, "damaged: has no frame hold of R1"),
        ({"hold_s": {"R1": "long"}}, "damaged"),
        ({"sources": 3}, "damaged"),
        ({"sources": ["a"]}, "damaged"),
        ({"sources": [{"poses": 3}]}, "damaged"),
        ({"map": "a"}, "damaged"),
    ],
)
def test_a_manifest_of_other_content_is_refused(tmp_path, changed, said):
    write(tmp_path / "v", straight_tiles(), drive(3, FIRST, np.arange(10.0)))
    path = tmp_path / "v" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))
    with pytest.raises(InputError, match=rf"manifest\.json: {said}"):
        read_vehicles(tmp_path / "v")


@pytest.mark.parametrize("shift", [0, 3])
def test_runs_of_a_tile_that_overlap_are_refused(tmp_path, shift):
    write(tmp_path / "v", straight_tiles(), drive(3, FIRST, np.arange(10.0)))
    path = tmp_path / "v" / "covered.parquet"
    runs = pq.read_table(path)
    again = runs.to_pandas().assign(last_step=lambda t: t["last_step"] + shift)
    both = pd.concat([runs.to_pandas(), again]).sort_values(["tile_id", "first_step"])
    pq.write_table(pa.Table.from_pandas(both, runs.schema, preserve_index=False), path)
    with pytest.raises(InputError, match=r"covered\.parquet: runs of tile \d+ overlap"):
        list(read_vehicles(tmp_path / "v").blocks())


def test_a_table_of_other_content_is_refused_by_its_file(tmp_path):
    write(tmp_path / "v", straight_tiles(), drive(3, FIRST, np.arange(10.0)))
    path = tmp_path / "v" / "vehicles.parquet"
    table = pq.read_table(path)
    text = pa.array(["long"])
    place = table.schema.get_field_index("length_m")
    kept = table.set_column(place, "length_m", text).replace_schema_metadata(table.schema.metadata)
    pq.write_table(kept, path)
    with pytest.raises(InputError, match=r"vehicles\.parquet: vehicles: length_m holds something"):
        read_vehicles(tmp_path / "v")
