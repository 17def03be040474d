"""Intervals of a heat map against a count by pandas; and heat maps read back."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing

import numpy as np
import pandas as pd
import pytest
from counted_sites import T0, two_sensors

import gis_radar as gr


@pytest.fixture(scope="module")
def site():
    return two_sensors()


def counted(site, steps, within=None):
    """Count hit and observed steps by tile and interval with pandas, step by step."""
    rows = [
        (step, tile)
        for key, delivered in site.delivered.items()
        for step in delivered
        for tile in site.seen.get(key, ())
    ]
    observed = pd.DataFrame(rows, columns=["step", "tile"]).drop_duplicates()
    hits = pd.DataFrame(sorted(site.hit), columns=["step", "tile"]).assign(hit=1)
    table = observed.merge(hits, how="left").fillna({"hit": 0})
    if within:
        table = table[(table["step"] >= within[0]) & (table["step"] < within[1])]
    table["time"] = pd.to_datetime(table["step"] // steps * steps * 50, unit="ms")
    return table.groupby(["tile", "time"])["hit"].agg(["sum", "count"]) / 20.0


def compared(rows, expected):
    """Compare every tile and interval with the count."""
    for row in rows.itertuples():
        key = row.tile_id, row.begin.tz_localize(None)
        if key in expected.index:
            assert (row.hit_s, row.observed_s) == pytest.approx(tuple(expected.loc[key]))
            assert row.hit_share == pytest.approx(row.hit_s / row.observed_s)
        else:
            assert row.observed_s == 0.0
            assert np.isnan([row.hit_s, row.hit_share]).all()


@pytest.mark.parametrize(("interval", "steps"), [("50ms", 1), ("2s", 40)])
def test_a_series_of_chosen_times(site, interval, steps):
    begin, end = (pd.Timestamp((T0 + k) * 50, unit="ms", tz="UTC") for k in (90, 171))
    rows = gr.make_heatmap(site.dataset, interval=interval, begin=begin, end=end).long()
    assert rows["begin"].max() < end <= rows["end"].max()
    expected = counted(site, steps, (T0 + 90, T0 + 171))
    cut = expected.reset_index()
    cut["time"] = cut["time"].clip(lower=begin.tz_localize(None))  # intervals are cut at the ends
    compared(rows, cut.set_index(["tile", "time"]))
    assert rows["hit_s"].sum() > 0.0


def test_of_tiles_that_no_sensor_sees_nothing_is_known(site):
    seen = {tile for tiles in site.seen.values() for tile in tiles}
    unseen = sorted({*range(16)} - seen)[:2]
    rows = gr.make_heatmap(site.dataset, interval="5s").long()
    rows = rows[rows["tile_id"].isin(unseen)]
    assert sorted(rows["tile_id"].unique()) == unseen != []
    compared(rows, counted(site, 100))


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"begin": "2023-11-14T22:13:21Z", "end": "2023-11-14T22:13:20Z"}, gr.UsageError, "ascend"),
        ({"begin": "2001-01-01", "end": "2001-01-02"}, gr.InputError, "no sensor"),
        ({"begin": "noon"}, gr.UsageError, "expected a time such as"),
    ],
)
def test_what_makes_no_sense_is_refused(site, options, error, words):
    with pytest.raises(error, match=words):
        gr.make_heatmap(site.dataset, interval="1s", **options)


@pytest.mark.parametrize("options", [{}, {"interval": "5s"}, {"interval": "50ms"}])
def test_a_heat_map_is_read_back_as_it_was(site, tmp_path, options):
    made = gr.make_heatmap(site.dataset, **options)
    made.write(tmp_path / "heat")
    for path in (tmp_path / "heat", tmp_path / "heat" / "heatmap.gpkg"):
        read = gr.read_heatmap(path)
        assert read.figures() == made.figures()
        assert read.metadata == made.metadata
        for name in ("wide", "long"):
            mine, theirs = (pd.DataFrame(getattr(h, name)()) for h in (read, made))
            pd.testing.assert_frame_equal(
                mine.drop(columns="geometry"), theirs.drop(columns="geometry")
            )
        assert read.wide().geometry.geom_equals(made.wide().geometry).all()
    read.write(tmp_path / "again")
    names = ("hits.tif", "heatmap.parquet", "heatmap.qml")
    for name in names:
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "heat" / name).read_bytes()


def test_a_heat_map_that_was_changed_is_not_read(site, tmp_path):
    gr.make_heatmap(site.dataset).write(tmp_path / "heat")
    file = tmp_path / "heat" / "heatmap.gpkg"
    changes = (
        ("UPDATE tiles SET lanelet_id = 8 WHERE tile_id = 15", "changed since"),
        ("DELETE FROM steps_by_interval WHERE tile_id = 3", "damaged"),
        ("DELETE FROM gpkg_metadata_reference", "lacks fingerprint"),
    )
    for number, (change, words) in enumerate(changes):
        other = tmp_path / f"{number}.gpkg"
        shutil.copyfile(file, other)
        with closing(sqlite3.connect(other)) as database, database:
            named = database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")
            for (trigger,) in named.fetchall():  # they need functions that SQLite lacks
                database.execute(f'DROP TRIGGER "{trigger}"')
            database.execute(change)
        with pytest.raises(gr.InputError, match=words):
            gr.read_heatmap(other)
    with pytest.raises(gr.InputError, match="no such file"):
        gr.read_heatmap(tmp_path)
    (tmp_path / "text.gpkg").write_text("no")
    with pytest.raises(gr.InputError, match="not a heat map"):
        gr.read_heatmap(tmp_path / "text.gpkg")


def test_the_folder_of_a_run_is_told_where_its_heat_map_lies(site, tmp_path):
    gr.make_heatmap(site.dataset).write(tmp_path / "heatmap")
    with pytest.raises(gr.InputError, match="no such file") as refusal:
        gr.read_heatmap(tmp_path)
    assert refusal.value.hint == f"did you mean {tmp_path / 'heatmap'}?"
