"""A dataset as one object: what it gives, and what it refuses."""

import json
from datetime import UTC, datetime

import numpy as np
import pandas as pd
import pytest
from datasets import BEGIN, HOUR, recordings_of, square_tiles, stored, write_dataset
from maps import EAST, NORTH, Listener

from gis_radar.base import STEPS_PER_HOUR, InputError, UsageError
from gis_radar.dataset import (
    HourWriter,
    Origin,
    open_dataset,
    part_path,
    record_path,
    require_same_site,
)
from gis_radar.dataset.files.tables import HITS, HOUR_TABLES, OBSERVED, TABLES

AFTER = BEGIN + STEPS_PER_HOUR
TRACK = {
    "vehicle": [HOUR * 1_000_000] * 2, "step": [BEGIN, BEGIN + 4], "x_cm": [150, 250],
    "y_cm": [-50, -50], "heading_cdeg": [9000, 9100], "speed_cms": [1000, 1050],
    "lanelet_id": np.ma.MaskedArray([9_007_199_254_740_993, 0], [False, True]),
    "s_cm": np.ma.MaskedArray([12, 0], [False, True]),
    "d_cm": np.ma.MaskedArray([-3, 0], [False, True]), "seen": [True, False],
}  # fmt: skip


@pytest.fixture
def dataset(tmp_path):
    hits = {"tile_id": [1, 1, 2], "step": [BEGIN, AFTER, BEGIN + 20]}
    runs = {
        "tile_id": [1, 1], "first_step": [BEGIN, AFTER], "last_step": [AFTER - 1, AFTER + 99]
    }  # fmt: skip
    rows = {"hits": hits, "observed": runs}
    return write_dataset(tmp_path / "data", rows, timezone="Europe/Berlin")


def test_times_are_utc(dataset):
    hits = dataset.hits()
    assert hits["tile_id"].tolist() == [1, 2, 1]
    assert hits["time"].iloc[1] == pd.Timestamp("2023-11-14T22:00:01Z")
    observed = dataset.observed()
    assert observed["end"].tolist()[0] == observed["begin"].tolist()[1]


@pytest.mark.parametrize(
    "begin",
    [
        "2023-11-14T22:00:01Z", "2023-11-14 23:00:01", "2023-11-14T23:00:01+01:00",
        datetime(2023, 11, 14, 22, 0, 1, tzinfo=UTC), BEGIN + 20,
    ],
    ids=str,
)  # fmt: skip
def test_begin_is_included_and_end_is_not(dataset, begin):
    assert len(dataset.hits(begin=begin)) == 2
    assert len(dataset.hits(end=begin)) == 1
    assert dataset.hits(begin=begin, end=AFTER)["tile_id"].tolist() == [2]


def test_runs_are_cut_to_the_span(dataset):
    found = dataset.observed(begin=AFTER - 20, end=AFTER + 20)
    assert ((found["end"] - found["begin"]) == pd.Timedelta(seconds=1)).all()


def test_tracks_are_in_metres_degrees_and_metres_a_second(tmp_path):
    tracks = write_dataset(tmp_path / "data", {"tracks": TRACK}).tracks()
    first = tracks.iloc[0]
    assert (first["easting"], first["northing"]) == (int(EAST) + 1.5, int(NORTH) - 0.5)
    assert (first["heading"], first["speed"], first["s_m"]) == (90.0, 10.0, 0.12)
    assert first["lanelet_id"] == 9_007_199_254_740_993
    assert tracks.iloc[1][["lanelet_id", "s_m", "d_m"]].isna().all()


def test_every_table_can_be_empty(tmp_path):
    dataset = write_dataset(tmp_path / "data", hours=[HOUR])
    for name in TABLES:
        assert stored(dataset, name).empty, name
    assert len(dataset.hours()) == 1
    assert "1 hour," in repr(dataset)


def test_a_new_dataset_says_that_it_holds_nothing(tmp_path):
    dataset = write_dataset(tmp_path / "data")
    assert dataset.hours().empty
    assert dataset.hits().empty
    assert repr(dataset).endswith("no sensors, 0 hours)")
    assert "<table>" in dataset._repr_html_()


def test_tiles_are_those_of_the_dataset(dataset):
    assert len(dataset.tiles()) == 20
    other = write_dataset(dataset.folder.parent / "other", tiles=square_tiles(3))
    (other.folder / "tiles.gpkg").replace(dataset.folder / "tiles.gpkg")
    with pytest.raises(InputError, match=r"tiles\.gpkg: has tiles .*, the dataset is of"):
        open_dataset(dataset.folder).tiles()


def test_an_hour_without_a_record_is_not_read(dataset):
    record_path(dataset.folder, HOUR).unlink()
    assert dataset.hits()["tile_id"].tolist() == [1]
    assert set(dataset.tile_counts()["begin"]) == {pd.Timestamp("2023-11-14T23:00Z")}


def test_a_missing_part_is_named(dataset):
    part_path(dataset.folder, HITS, HOUR).unlink()
    with pytest.raises(InputError, match=r"hits.date=2023-11-14.22\.parquet: is missing"):
        dataset.hits()
    assert len(dataset.observed()) == 2


def test_a_changed_byte_is_found(dataset):
    dataset.check()
    path = part_path(dataset.folder, OBSERVED, HOUR)
    whole = bytearray(path.read_bytes())
    whole[8] ^= 1
    path.write_bytes(whole)
    with pytest.raises(InputError, match="its bytes have changed"):
        dataset.check()
    with pytest.raises(InputError, match="damaged: "):
        dataset.observed()


def test_without_vehicles_their_tables_are_named_as_missing(tmp_path):
    rows = {"observed": {"tile_id": [1], "first_step": [BEGIN], "last_step": [BEGIN + 9]}}
    dataset = write_dataset(tmp_path / "data", rows, vehicles=False)
    with pytest.raises(InputError, match="the hour 2023-11-14T22:00Z has no tracks") as refused:
        dataset.tracks()
    assert "without vehicles" in refused.value.hint
    for asked in (dataset.lanes, lambda: dataset.query("SELECT lane FROM lanes")):
        with pytest.raises(InputError, match="data: holds no vehicles"):
            asked()
    assert dataset.tile_counts()[["observed_steps", "hidden_steps"]].to_numpy().tolist() == [
        [10, 0]
    ]


def test_two_methods_are_said(dataset):
    origin = Origin(fingerprint=dataset.manifest.fingerprint, method=2, inputs="abc")
    with HourWriter(folder=dataset.folder, hour=HOUR + 5, origin=origin) as writer:
        for table in HOUR_TABLES:
            writer.write(table, table.empty())
    listener = Listener()
    assert open_dataset(dataset.folder, reporter=listener).methods == [1, 2]
    assert "methods 1, 2" in listener.messages[0][1]


def test_hours_of_other_tiles_are_refused(dataset):
    origin = Origin(fingerprint="f00d", method=1, inputs="abc")
    with HourWriter(folder=dataset.folder, hour=HOUR, origin=origin) as writer:
        writer.write(HITS, HITS.empty())
    with pytest.raises(InputError, match="2023-11-14T22:00Z was made from other tiles"):
        dataset.hits()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 2}, "has schema 2, newer than 1"),
        ({"origin": [1]}, "damaged"),
        ({"crs": 5}, "damaged: crs is no text"),
        ({"settings": 5}, "damaged: settings are none"),
        ({"further": 5}, "damaged"),
    ],
)
def test_manifests_that_are_none_are_refused(dataset, change, message):
    path = dataset.folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=message) as refused:
        open_dataset(dataset.folder)
    assert str(dataset.folder) in refused.value.message


def test_folders_that_are_no_dataset_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"is no dataset: lacks dataset\.json"):
        open_dataset(tmp_path)
    with pytest.raises(InputError, match="is no dataset"):
        open_dataset(tmp_path / "nothing")


def test_a_dataset_tells_its_first_and_its_last_frame(tmp_path):
    rows = recordings_of({"R1", "R2"})
    rows |= {"first_time": [1.7e9, 1.7e9 + 5], "last_time": [1.7e9 + 60, 1.7e9 + 90]}
    figures = write_dataset(tmp_path / "data", recordings=rows).figures()
    assert figures["first_frame"] == "2023-11-14T22:13:20Z"
    assert figures["last_frame"] == "2023-11-14T22:14:50Z"


def test_a_folder_of_results_is_told_where_its_dataset_is(dataset, tmp_path):
    dataset.folder.rename(dataset.folder.with_name("dataset"))
    results = dataset.folder.parent
    with pytest.raises(InputError, match="is no dataset") as refused:
        open_dataset(results)
    assert refused.value.hint == f"did you mean {results / 'dataset'}?"


@pytest.mark.parametrize(
    ("other", "what"),
    [
        ({"map_digest": "1"}, "map"),
        ({"fingerprint": "1"}, "set of tiles"),
        ({"crs": "1"}, "coordinate"),
    ],
)
def test_what_is_added_is_of_the_same_site(dataset, other, what):
    manifest = dataset.manifest
    same = {"map_digest": manifest.map, "fingerprint": manifest.fingerprint, "crs": manifest.crs}
    require_same_site(dataset.folder, manifest, **same)
    with pytest.raises(InputError, match=f"was made with another {what}"):
        require_same_site(dataset.folder, manifest, **(same | other))


def test_an_end_before_the_begin_is_refused(dataset):
    with pytest.raises(UsageError, match="is not after begin"):
        dataset.hits(begin="2023-11-14T22:00Z", end="2023-11-14T22:00Z")
    with pytest.raises(UsageError, match="expected a time"):
        dataset.hits(begin="yesterday")
