"""A dataset in PostGIS: the same figures, only what changed, and never half of it."""

import shutil
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from driven import drive, driven, straight_tiles
from maps import Listener
from postgres import needs_postgis, server
from shapely import LineString

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset import (
    LaneTraffic,
    part_path,
    read_hours,
    write_record,
    write_single_file,
)
from gis_radar.dataset.files.tables import TABLES
from gis_radar.products.postgis import VERSION

psycopg = pytest.importorskip("psycopg")
pytestmark = needs_postgis

EXACT_TABLES = ("frames", "hits", "observed", "visible", "occupied", "tracks")
HOUR = 472_222  # 2023-11-14, 22 h
TILES = straight_tiles(120)
LANES = gpd.GeoDataFrame(
    {
        "lane": [7], "lanelets": [[7]], "subtype": ["road"], "street": ["Ring"],
        "street_part": [None], "turn": ["left"], "stop_line_m": [50.0], "speed_limit_kmh": [36.0],
        "length_m": [60.0],
    },
    geometry=[LineString([(0, 0), (60, 0)])], crs="EPSG:25832",
)  # fmt: skip


class Acting(Listener):
    """Does something when so many dates were sent."""

    def __init__(self, sent, act):
        super().__init__()
        self.sent, self.act = sent, act

    def progress(self, stage, done, total):
        super().progress(stage, done, total)
        if done == self.sent:
            self.act()


def days(folder, hours):
    """Write a dataset in which cars drive by in each of these hours, from its begin to its end."""
    fronts = np.arange(0.0, 59.0, 0.5)
    tracks = [
        drive(hour * 1_000_000 + n, hour * STEPS_PER_HOUR + begin, fronts)
        for hour in hours
        for n, begin in enumerate([0, 4000, STEPS_PER_HOUR - len(fronts)])
    ]
    return driven(folder, TILES, pd.concat(tracks), lanes=LANES, timezone="Europe/Berlin")


@pytest.fixture(scope="module")
def database():
    with server() as url:
        yield url


@pytest.fixture
def asked(database):
    """Ask the database, which is empty again afterwards."""
    with psycopg.connect(database, autocommit=True) as connection:
        yield lambda sql: connection.execute(sql).fetchall()
        names = "SELECT nspname FROM pg_namespace WHERE nspname ~ '^(gis_radar|a$)'"
        for (name,) in connection.execute(names).fetchall():
            connection.execute(f'DROP SCHEMA "{name}" CASCADE')


@pytest.fixture(scope="module")
def two_days(tmp_path_factory):
    return days(tmp_path_factory.mktemp("two") / "data", [HOUR, HOUR + 1, HOUR + 2])


@pytest.fixture(scope="module")
def first_hour(tmp_path_factory):
    return days(tmp_path_factory.mktemp("one") / "data", [HOUR])


def test_the_database_holds_what_the_dataset_holds(database, asked, two_days, tmp_path):
    done = gr.publish(two_days, database)
    assert (done.sent, done.kept, done.removed) == (2, 0, 0)
    traffic = two_days.traffic()
    stored = asked(
        "SELECT lane, begin_time, counted, volume, speed_kmh, queue_max_m "
        "FROM gis_radar.lane_measures ORDER BY lane, begin_time"
    )
    columns = ["lane", "begin", "counted", "volume", "speed_kmh", "queue_max_m"]
    found = pd.DataFrame(stored, columns=columns)
    found["begin"] = pd.DatetimeIndex(found["begin"]).tz_convert("Europe/Berlin").as_unit("us")
    expected = pd.DataFrame(traffic[columns]).sort_values(["lane", "begin"], ignore_index=True)
    assert expected["volume"].sum() > 5
    pd.testing.assert_frame_equal(found, expected, check_dtype=False)
    ((occupied, visible),) = asked(
        "SELECT sum(occupied_steps), sum(visible_steps) FROM gis_radar.tile_counts"
    )
    counts = two_days.tile_counts()
    sums = counts[["occupied_steps", "visible_steps"]].sum().tolist()
    assert [int(occupied), int(visible)] == sums
    shares = asked("SELECT tile_id, occupancy FROM gis_radar.occupancy ORDER BY tile_id")
    by_tile = counts.groupby("tile_id")[["occupied_steps", "visible_steps"]].sum()
    share = by_tile["occupied_steps"] / by_tile["visible_steps"]
    assert [one for _, one in shares] == pytest.approx(share.tolist())
    ((area, srid),) = asked(
        "SELECT sum(ST_Area(geometry)), min(ST_SRID(geometry)) FROM gis_radar.tiles"
    )
    assert (area, srid) == (pytest.approx(TILES.area.sum()), 25832)
    assert asked("SELECT name FROM gis_radar.latest_traffic") == [(traffic["name"].iloc[0],)]
    folder = shutil.copytree(two_days.folder, tmp_path / "named")
    for name in ("To the harbour", "To the quay"):
        gr.open_dataset(folder).state_lanes([{"id": int(traffic["lane"].iloc[0]), "name": name}])
        assert gr.publish(folder, database).sent == 0
        assert asked("SELECT name FROM gis_radar.latest_traffic") == [(name,)]


def test_only_what_changed_is_sent(database, asked, two_days, tmp_path):
    gr.publish(days(tmp_path / "one", [HOUR, HOUR + 1]), database)
    row = "SELECT xmin::text FROM gis_radar.lane_measures WHERE begin_time < '2023-11-14 23:30Z'"
    before = asked(row)
    added = gr.publish(two_days, database)
    assert (added.sent, added.kept, added.removed) == (1, 1, 0)
    assert asked(row) == before
    again = gr.publish(two_days, database)
    assert (again.sent, again.kept) == (0, 2)
    whole = asked("SELECT * FROM gis_radar.tile_counts ORDER BY 1, 2")
    shares = asked("SELECT * FROM gis_radar.tile_sums ORDER BY 1")
    withdrawn = gr.publish(days(tmp_path / "later", [HOUR + 2]), database)
    assert (withdrawn.sent, withdrawn.removed) == (1, 1)
    ((left,),) = asked("SELECT count(*) FROM gis_radar.tile_counts")
    assert 0 < left < len(whole)
    counted = (
        "SELECT tile_id, count(*), sum(occupied_steps)::bigint, sum(visible_steps)::bigint "
        "FROM gis_radar.tile_counts GROUP BY 1 ORDER BY 1"
    )
    assert asked("SELECT * FROM gis_radar.tile_sums ORDER BY 1") == asked(counted)
    gr.publish(two_days, database)
    assert asked("SELECT * FROM gis_radar.tile_counts ORDER BY 1, 2") == whole
    assert asked("SELECT * FROM gis_radar.tile_sums ORDER BY 1") == shares == asked(counted)


def test_what_ends_midway_changes_nothing(database, asked, two_days, first_hour):
    gr.publish(first_hour, database)
    before = asked("SELECT * FROM gis_radar.tile_counts ORDER BY 1, 2")

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gr.publish(two_days, database, reporter=Acting(1, stop))

    def end():  # as a server does that is started anew
        asked(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
            "WHERE application_name = 'gis-radar'"
        )

    with pytest.raises(gr.OutputError, match=r"terminating connection|closed") as caught:
        gr.publish(two_days, database, reporter=Acting(1, end))
    assert caught.value.hint == "the database is as it was"
    assert asked("SELECT * FROM gis_radar.tile_counts ORDER BY 1, 2") == before


def test_a_schema_of_something_else_is_refused(database, asked, two_days, tmp_path):
    gr.publish(two_days, database)
    tiles = straight_tiles(40)
    tracks = drive(HOUR * 1_000_000, HOUR * STEPS_PER_HOUR, np.arange(0.0, 19.0, 0.5))
    other = driven(tmp_path / "other", tiles, tracks, lanes=LANES)
    with pytest.raises(gr.OutputError, match="schema gis_radar holds something else") as ours:
        gr.publish(other, database)
    assert "or drop gis_radar" in str(ours.value.hint)
    with pytest.raises(gr.OutputError, match="schema public holds something else") as theirs:
        gr.publish(other, database, schema="public")
    assert theirs.value.hint == "name another --schema"
    assert gr.publish(other, database, schema="a").sent == 1


def test_two_at_once_do_not_meet(database, asked, two_days):
    def second():
        with pytest.raises(gr.OutputError, match="is being published just now"):
            gr.publish(two_days, database)
        refused.append(True)

    refused = []
    gr.publish(two_days, database, reporter=Acting(0, second))
    assert refused


def test_names_are_right_in_a_database_of_another_encoding(asked, database, two_days, monkeypatch):
    name = "Bäckerstraße"
    lane = int(LANES["lane"].iloc[0])
    named = two_days.with_lanes([{"id": lane, "name": name}])
    asked("SELECT 1")
    for encoding in ("LATIN1", "SQL_ASCII"):
        with psycopg.connect(database, autocommit=True) as connection:
            connection.execute(
                f"CREATE DATABASE {encoding} ENCODING '{encoding}' TEMPLATE template0 "
                "LC_COLLATE 'C' LC_CTYPE 'C'"
            )
        other = database.replace("/postgres?", f"/{encoding.lower()}?")
        gr.publish(named, other)
        assert gr.publish(named, other).kept == 2
        with psycopg.connect(other, client_encoding="utf8") as connection:
            assert connection.execute("SELECT name FROM gis_radar.lanes").fetchone() == (name,)
    monkeypatch.setenv("PGCLIENTENCODING", "LATIN1")
    gr.publish(named, database)
    monkeypatch.delenv("PGCLIENTENCODING")
    assert asked("SELECT name FROM gis_radar.lanes") == [(name,)]


def test_free_speeds_and_a_new_method_of_lane_measures_are_sent(
    database, asked, two_days, monkeypatch
):
    gr.publish(two_days, database)
    slow = two_days.with_lanes([{"id": 7, "speed_kmh": 90.0}])
    assert gr.publish(slow, database).sent == 2
    stored = asked("SELECT sum(delay_s) FROM gis_radar.lane_measures")
    assert stored[0][0] == pytest.approx(slow.traffic()["delay_s"].sum())
    assert stored[0][0] > two_days.traffic()["delay_s"].sum()
    monkeypatch.setattr("gis_radar.dataset.days.lane_measures.LANES_METHOD", 99)
    assert gr.publish(slow, database).sent == 2
    assert gr.publish(slow, database).kept == 2


def test_a_table_that_another_holds_is_waited_for_only_for_a_time(
    database, asked, two_days, monkeypatch
):
    gr.publish(two_days, database)
    monkeypatch.setattr("gis_radar.products.postgis.LOCK_S", 0.2)
    with psycopg.connect(database) as other:
        other.execute("LOCK TABLE gis_radar.lanes IN ACCESS EXCLUSIVE MODE")
        with pytest.raises(gr.OutputError, match="lock timeout") as caught:
            gr.publish(two_days, database)
    assert "another program" in str(caught.value.hint)


def test_a_reader_reads_and_writes_nothing_and_listeners_hear_of_it(database, asked, two_days):
    with psycopg.connect(database, autocommit=True) as listener:
        listener.execute("DROP ROLE IF EXISTS planner")
        listener.execute("CREATE ROLE planner LOGIN")
        listener.execute("LISTEN qgis")
        gr.publish(two_days, database, reader="planner")
        (heard,) = listener.notifies(timeout=5.0, stop_after=1)
        assert heard.payload == "gis_radar gis_radar"
    with psycopg.connect(database.replace("postgres@", "planner@"), autocommit=True) as planner:
        assert planner.execute("SELECT count(*) FROM gis_radar.occupancy").fetchone() == (120,)
        with psycopg.connect(database, autocommit=True) as publisher:
            publisher.execute("CREATE TABLE gis_radar.later (x int)")
        assert planner.execute("SELECT count(*) FROM gis_radar.later").fetchone() == (0,)
        for statement in ("DELETE FROM gis_radar.tiles", "CREATE TABLE gis_radar.mine (x int)"):
            with pytest.raises(psycopg.errors.InsufficientPrivilege):
                planner.execute(statement)


def test_a_sensor_stands_where_its_last_recording_was_made(database, asked, first_hour, tmp_path):
    dataset = gr.open_dataset(shutil.copytree(first_hour.folder, tmp_path / "data"))
    for name, changes in (
        ("poses", {"pose": "R1-new", "track": "R1-new", "sight": "R1-new", "height": 9.5}),
        ("recordings",
         {"pose": "R1-new", "path": "later.parquet", "last_time": 1.8e9, "digest": "f",
          "sights": None}),
    ):  # fmt: skip
        old = pq.read_table(dataset.folder / f"{name}.parquet")
        row = pa.Table.from_pylist([old.to_pylist()[0] | changes], old.schema)
        rows = pa.concat_tables([row, old])
        rows = rows.sort_by([(column, "ascending") for column in TABLES[name].order])
        write_single_file(TABLES[name], dataset.folder, rows, dataset.manifest.fingerprint)
    gr.publish(gr.open_dataset(dataset.folder), database)
    assert asked("SELECT pose, height FROM gis_radar.sensors") == [("R1-new", 9.5)]


@pytest.mark.parametrize(
    ("url", "code", "said"),
    [
        ("no address", 2, "the address of the database is none"),
        ("postgresql://me:secret@localhost:9/city?connect_timeout=1", 3, "localhost/city: "),
    ],
)
def test_a_database_that_is_not_there_is_one_line(run, two_days, url, code, said):
    got, _, err = run("publish", two_days.folder, url)
    assert got == code
    assert said in err
    assert "secret" not in err


def test_a_name_of_a_schema_that_is_none_is_refused(two_days):
    with pytest.raises(gr.UsageError, match="is no name"):
        gr.publish(two_days, "postgresql:///x", schema='a"; DROP TABLE b; --')


@pytest.fixture
def city(two_days, first_hour, tmp_path):
    """A city of two sites; one of them saw one day."""
    shutil.copytree(first_hour.folder, tmp_path / "city" / "site=ost")
    shutil.copytree(two_days.folder, tmp_path / "city" / "site=Münchner Ring")
    return tmp_path / "city"


def test_a_city_has_a_schema_a_site_and_views_of_all(database, asked, city, two_days):
    listener = psycopg.connect(database, autocommit=True)
    listener.execute("LISTEN qgis")
    done = gr.publish_city(city, database)
    heard = [each.payload for each in listener.notifies(timeout=5.0, stop_after=3)]
    assert heard == [
        "gis_radar gis_radar", "gis_radar gis_radar_munchner_ring", "gis_radar gis_radar_ost"
    ]  # fmt: skip
    assert {name: each.sent for name, each in done.sites.items()} == {"Münchner Ring": 2, "ost": 1}
    for table in ("tile_counts", "lane_measures", "occupancy", "tiles", "latest_traffic"):
        counted = "SELECT count(*) FROM "
        own = [asked(f"{counted} gis_radar_{each}.{table}") for each in ("munchner_ring", "ost")]
        both = [asked(f"{counted} gis_radar.{table} WHERE site = '{site}'") for site in done.sites]
        assert both == own
        assert own[0][0][0] >= own[1][0][0] > 0
    kinds = "SELECT Find_SRID('gis_radar', 'occupancy', 'geometry')"
    assert asked(kinds) == [(25832,)]
    again = gr.publish_city(city, database)
    assert {each.sent for each in again.sites.values()} == {0}
    assert again.figures()["dates_kept"] == 3
    heard = [each.payload for each in listener.notifies(timeout=1.0)]
    assert heard == ["gis_radar gis_radar"]  # nothing else has changed
    listener.close()


def test_a_site_that_fails_stops_no_other(database, asked, city, run):
    gr.publish_city(city, database)
    before = asked("SELECT count(*) FROM gis_radar_ost.tile_counts")
    days(city.parent / "more", [HOUR, HOUR + 30])
    shutil.rmtree(city / "site=Münchner Ring")
    shutil.copytree(city.parent / "more", city / "site=Münchner Ring")
    (city / "site=ost" / "recordings.parquet").write_bytes(b"no table")
    record = next((city / "site=ost" / "hours").rglob("*.json"))
    record.write_text("{}")
    code, _, err = run("publish", city, database)
    assert code == 3
    assert "1 of 2 sites were not published: ost" in err
    assert "warning: site ost: " in err
    assert asked("SELECT count(*) FROM gis_radar_ost.tile_counts") == before
    days_of = "SELECT count(*) FROM gis_radar.publication WHERE site = 'Münchner Ring'"
    assert asked(days_of) == [(3,)]
    assert asked("SELECT count(*) FROM gis_radar.tile_counts WHERE site = 'ost'") == before


def test_a_city_whose_schema_is_another_sends_nothing(database, asked, city, two_days):
    gr.publish(two_days, database)
    with pytest.raises(gr.OutputError, match="schema gis_radar holds something else"):
        gr.publish_city(city, database)
    assert asked("SELECT count(*) FROM pg_namespace WHERE nspname ~ '^gis_radar_'") == [(0,)]
    for name in ("site=o st", "site=o-st"):
        (city / name).mkdir()
        shutil.copy(city / "site=ost" / "dataset.json", city / name)
    with pytest.raises(gr.InputError, match=r"site o[- ]st would be in schema a_o_st"):
        gr.publish_city(city, database, schema="a")


def test_tables_of_an_older_version_are_named_and_left(database, asked, two_days):
    gr.publish(two_days, database)
    asked_for = "SELECT obj_description('gis_radar'::regnamespace, 'pg_namespace')"
    ((told,),) = asked(asked_for)
    older = told.replace(f"version {VERSION}", "version 1")
    with psycopg.connect(database, autocommit=True) as connection:
        connection.execute(f"COMMENT ON SCHEMA gis_radar IS '{older}'")
    with pytest.raises(gr.OutputError, match="tables of version 1") as caught:
        gr.publish(two_days, database)
    assert "drop gis_radar and publish again" in str(caught.value.hint)
    assert asked(asked_for) == [(older,)]


def test_dates_whose_exact_tables_were_deleted_are_not_sent_again(
    database, asked, two_days, tmp_path
):
    dataset = gr.open_dataset(shutil.copytree(two_days.folder, tmp_path / "data"))
    gr.publish(dataset, database)
    before = asked("SELECT * FROM gis_radar.lane_measures ORDER BY 1, 2")
    traffic = LaneTraffic(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint)
    for record in read_hours(dataset.folder).values():
        traffic.update(record.hour)  # as `keep` does before
    for record in read_hours(dataset.folder).values():
        write_record(dataset.folder, replace(record, dropped=EXACT_TABLES))
        for name in EXACT_TABLES:
            part_path(dataset.folder, TABLES[name], record.hour).unlink()
    again = gr.publish(gr.open_dataset(dataset.folder), database)
    assert (again.sent, again.kept) == (0, 2)
    fresh = gr.publish(gr.open_dataset(dataset.folder), database, schema="a")
    assert fresh.sent == 2
    assert asked("SELECT * FROM a.lane_measures ORDER BY 1, 2") == before
