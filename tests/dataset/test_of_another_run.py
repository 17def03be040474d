"""Files of a dataset that come from another run, or were edited, are refused by name."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from maps import Listener
from measured import MAP, contents, cut, sample_pose, tiles

import gis_radar as gr
from gis_radar.dataset import write_single_file
from gis_radar.dataset.files.pose_book import PoseBook
from gis_radar.dataset.files.schema import column_digest
from gis_radar.dataset.files.tables import SIGHTS


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return cut(tmp_path_factory.mktemp("files") / "R1.parquet", "R1", 10.0, 11.0, edge_s=-300.0)


def site_of(folder, recording, *, pose=None, of=None, **options):
    pose = sample_pose("R1") if pose is None else pose
    options = {"check": False, "hits_only": True} | options
    return gr.measure([recording], [pose], tiles() if of is None else of, MAP, folder, **options)


def lower(table):
    return table.assign(height_m=table["height_m"] - 1.0)


@pytest.fixture
def dataset(recording, tmp_path):
    return site_of(tmp_path / "site", recording)


@pytest.mark.parametrize("names", [("sights.parquet",), ("poses.parquet",),
                                   ("sights.parquet", "poses.parquet")])  # fmt: skip
def test_poses_and_sights_of_another_run(dataset, recording, tmp_path, names):
    """The other run has the same tiles; its sensor sees them more narrowly."""
    pose = sample_pose("R1")
    narrow = replace(pose, view=replace(pose.view, max_range_m=60.0))
    other = site_of(tmp_path / "other", recording, pose=narrow)
    for name in names:
        shutil.copy(other.folder / name, dataset.folder / name)
    for use in (dataset.sights, dataset.poses, lambda: dataset.sight_of("R1"),
                lambda: dataset.withdraw(sensor="R1")):  # fmt: skip
        with pytest.raises(gr.InputError, match=rf"{names[0]}|{names[-1]}|damaged: KeyError"):
            use()


def test_sights_by_another_scan(dataset, tmp_path):
    """The pose is the same, and so is its name; what stands hides a tile."""
    path = dataset.folder / "sights.parquet"
    rows = pq.read_table(path)
    write_single_file(SIGHTS, dataset.folder, rows.slice(1), dataset.manifest.fingerprint)
    with pytest.raises(gr.InputError, match=r"sights\.parquet: is not of the run"):
        dataset.sights()


def test_sights_without_their_digest_are_read(dataset, recording):
    """A dataset of an earlier version has none."""
    path = dataset.folder / "recordings.parquet"
    with pq.ParquetFile(path) as file:
        table, metadata = file.read(), file.metadata.metadata
    metadata = {key: each for key, each in metadata.items() if key != b"ARROW:schema"}
    pq.write_table(table.drop_columns(["sights"]).replace_schema_metadata(metadata), path)
    assert len(dataset.sights())
    assert dataset.recordings()["sights"].isna().all()
    assert len(dataset.query("SELECT sights FROM recordings")) == 1
    listener = Listener()
    site_of(dataset.folder, recording, reporter=listener)
    assert not any("made again" in str(each) for each in listener.lines)
    dataset.withdraw(sensor="R1")
    assert len(dataset.recordings()) == 0


def other_sights(patched):
    """Find sights as another version of gis_radar, or another processor, may."""
    patched.setattr("gis_radar.measures.pose_sights.road_near", lambda *_: 1.0)


def test_sights_that_another_version_finds_of_the_same_pose(dataset, tmp_path, monkeypatch):
    later = cut(tmp_path / "later.parquet", "R1", 12.0, 13.0, edge_s=-300.0 - 7200.0)
    other_sights(monkeypatch)
    site_of(dataset.folder, later)
    assert len(dataset.sights())
    assert len(dataset.recordings()) == 2
    dataset.withdraw([later])


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_run_that_is_killed_while_sights_change_is_resumed(
    dataset, recording, tmp_path, monkeypatch, when
):
    write = PoseBook.write

    def killed(*given):
        if when == "after":
            write(*given)
        raise KeyboardInterrupt

    other_sights(monkeypatch)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(PoseBook, "write", killed)
        site_of(dataset.folder, recording)
    site_of(dataset.folder, recording)
    site_of(tmp_path / "never", recording)
    assert contents(dataset.folder) == contents(tmp_path / "never")


def test_a_dataset_without_a_digest_of_heights_is_not_made_anew(dataset, recording):
    path, note = dataset.folder / "dataset.json", dataset.folder / "note.txt"
    document = json.loads(path.read_text())
    del document["heights"], document["digest"]
    path.write_text(json.dumps(document))
    note.write_text("it is the same folder")
    site_of(dataset.folder, recording, only=True)
    assert note.exists()
    site_of(dataset.folder, recording, only=True, of=tiles(), timezone="Europe/Berlin")
    assert not note.exists()


def test_heights_that_are_unknown_are_those_of_the_file(recording, tmp_path):
    """A NaN of a calculation may have a sign, which no file keeps."""
    unknown = tiles().assign(height_m=-np.nan)
    assert np.signbit(unknown["height_m"]).all()
    assert site_of(tmp_path / "site", recording, of=unknown).tiles()["height_m"].isna().all()


def test_tiles_of_another_run(dataset, recording, tmp_path):
    """The other run's tiles have other heights, by which detections become hits."""
    other = site_of(tmp_path / "other", recording, of=lower(tiles()))
    with pytest.raises(gr.InputError, match="was made with another set of road heights"):
        site_of(dataset.folder, recording, of=lower(tiles()))
    shutil.copy(other.folder / "tiles.gpkg", dataset.folder / "tiles.gpkg")
    for use in (dataset.tiles, dataset.lanes, lambda: dataset.withdraw(sensor="R1")):
        with pytest.raises(gr.InputError, match=r"tiles\.gpkg: .* of another run"):
            use()


def test_a_map_of_another_run(recording, tmp_path):
    dataset = site_of(tmp_path / "site", recording, hits_only=False)
    path = dataset.folder / "map.osm"
    path.write_text(path.read_text().replace("</osm>", "<!-- edited --></osm>"))
    gr.open_dataset(dataset.folder)
    with pytest.raises(gr.InputError, match=r"map\.osm: .* of another run"):
        dataset.withdraw(sensor="R1")


@pytest.mark.parametrize("name", ["map.osm", "tiles.gpkg", "recordings.parquet", "sights.parquet"])
def test_a_file_of_a_dataset_that_is_gone(recording, tmp_path, name):
    dataset = site_of(tmp_path / "site", recording, hits_only=False)
    (dataset.folder / name).unlink()
    with pytest.raises(gr.InputError, match=f"site/{name}"):
        dataset.check()


@pytest.mark.parametrize(
    ("name", "value"),
    [("origin", [690219, 5336037]), ("crs", "EPSG:25833"), ("map", "another"), ("heights", "")],
)
def test_an_edited_manifest_is_refused(dataset, name, value):
    path = dataset.folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: value}))
    with pytest.raises(gr.InputError, match=r"dataset\.json: was edited after it was written"):
        gr.open_dataset(dataset.folder)


def test_edited_settings_are_refused(dataset):
    path = dataset.folder / "dataset.json"
    document = json.loads(path.read_text())
    document["settings"]["filters"]["sigmas"] = 3.0
    path.write_text(json.dumps(document))
    with pytest.raises(gr.InputError, match="was edited"):
        gr.open_dataset(dataset.folder)


def test_the_time_zone_can_be_edited(dataset):
    """Hours do not follow from it."""
    path = dataset.folder / "dataset.json"
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"timezone": "Europe/Berlin"}))
    assert gr.open_dataset(dataset.folder).timezone == "Europe/Berlin"
    path.write_text(json.dumps(document | {"timezone": "Berlin"}))
    with pytest.raises(gr.InputError, match=r"dataset\.json: there is no time zone 'Berlin'"):
        gr.open_dataset(dataset.folder)


def edit(path, name, change):
    """Change a column by pyarrow, and keep the metadata."""
    with pq.ParquetFile(path) as file:
        table, metadata = file.read(), file.metadata.metadata
    place = table.schema.get_field_index(name)
    changed = change(table[name].combine_chunks())
    table = table.set_column(place, table.schema.field(name), changed)
    metadata = {key: each for key, each in metadata.items() if key != b"ARROW:schema"}
    pq.write_table(table.replace_schema_metadata(metadata), path)


@pytest.mark.parametrize("name", ["tile_id", "interval", "hit_steps", "occupied_variance"])
def test_an_edited_table_of_a_date_is_named(dataset, name):
    (path,) = dataset.folder.glob("tile_counts/*/day.parquet")
    edit(path, name, lambda values: pc.cast(pc.add(values, 1), values.type))
    for use in (dataset.tile_counts, dataset.check, lambda: gr.make_heatmap(dataset)):
        with pytest.raises(gr.InputError, match=rf"day\.parquet: column {name} was changed") as e:
            use()
        assert "counts that day again" in str(e.value.hint)
    path.unlink()
    assert np.all(dataset.tile_counts()["observed_steps"] > 0)


def test_edited_lane_measures_are_named(recording, tmp_path):
    dataset = site_of(tmp_path / "site", recording, hits_only=False)
    (path,) = dataset.folder.glob("lane_measures/*/day.parquet")
    edit(path, "lane", lambda values: pc.add(values, 1))
    with pytest.raises(gr.InputError, match=r"day\.parquet: column lane was changed"):
        gr.make_traffic(dataset)


@pytest.mark.parametrize(
    "other", [["R1", None, "", "Ü"], ["R1", "", None, "Ü"], ["R", "1", "", "Ü"]]
)
def test_a_digest_is_of_the_values_not_of_how_they_are_stored(other):
    texts = ["R1", None, "", "Ü", None]
    whole = column_digest(pa.chunked_array([texts]))
    parts = pa.chunked_array([["x", *texts[:2]], [], [*texts[2:], "y"]], pa.string())
    assert column_digest(parts.slice(1, 5)) == whole
    assert (column_digest(pa.chunked_array([[*other, None]])) == whole) == (other == texts[:4])
