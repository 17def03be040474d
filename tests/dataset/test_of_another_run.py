"""Files of a dataset that come from another run, or were edited, are refused by name."""

import shutil
from dataclasses import replace

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from measured import MAP, cut, sample_pose, tiles

import gis_radar as gr
from gis_radar.dataset import write_single_file
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


def test_sights_without_their_digest_are_read(dataset):
    """A dataset of an earlier version has none."""
    path = dataset.folder / "recordings.parquet"
    with pq.ParquetFile(path) as file:
        table, metadata = file.read(), file.metadata.metadata
    metadata = {key: each for key, each in metadata.items() if key != b"ARROW:schema"}
    pq.write_table(table.drop_columns(["sights"]).replace_schema_metadata(metadata), path)
    assert len(dataset.sights())
    dataset.withdraw(sensor="R1")


def test_tiles_of_another_run(dataset, recording, tmp_path):
    """The other run's tiles have other heights, by which detections become hits."""
    other = site_of(tmp_path / "other", recording, of=lower(tiles()))
    with pytest.raises(gr.InputError, match="was made with another heights of the road"):
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
