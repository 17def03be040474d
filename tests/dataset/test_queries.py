"""SQL over a dataset: answers as other readers give them, and nothing but answers."""

import os
import signal
import threading
import time
from contextlib import suppress
from functools import partial

import pandas as pd
import pyarrow.dataset as pads
import pytest
from datasets import BEGIN, HOUR, square_tiles, stored, write_dataset

from gis_radar.base import STEPS_PER_HOUR, InputError, UsageError
from gis_radar.dataset import TileCounts, part_path, read_hours, record_path
from gis_radar.dataset.files.tables import HITS, TABLES
from gis_radar.dataset.questions.profiles import roll_ups

AFTER = BEGIN + STEPS_PER_HOUR


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    rows = {
        "hits": {"tile_id": [1, 1, 2], "step": [BEGIN, AFTER, BEGIN + 20]},
        "observed": {
            "tile_id": [1, 1], "first_step": [BEGIN, AFTER], "last_step": [AFTER - 1, AFTER + 99],
        },
    }  # fmt: skip
    place = tmp_path_factory.mktemp("it's =odd") / "data"
    return write_dataset(place, rows, timezone="Europe/Berlin")


@pytest.fixture
def dataset(tmp_path, measured):
    """A copy of one's own to damage."""
    rows = {"hits": {"tile_id": [1, 1, 2], "step": [BEGIN, AFTER, BEGIN + 20]}}
    return write_dataset(tmp_path / "data", rows)


@pytest.mark.parametrize("name", TABLES)
def test_views_hold_what_the_methods_give(measured, name):
    by_method = stored(measured, name).drop(columns="geometry", errors="ignore")
    by_sql = measured.query(f"FROM {name}")
    shared = [column for column in by_method if column in by_sql]
    assert shared == list(by_method)
    pd.testing.assert_frame_equal(by_sql[shared], by_method, check_dtype=False)
    assert [*by_sql][: len(TABLES[name].names)] == TABLES[name].names


def test_files_are_read_as_they_lie_there_by_others(measured):
    mine = measured.query("SELECT tile_id, step FROM hits ORDER BY step, tile_id")
    places = sorted((measured.folder / "hits").glob("*/*.parquet"))
    theirs = pads.dataset(places, format="parquet").to_table(columns=["tile_id", "step"])
    assert theirs.sort_by("step").to_pydict() == mine.to_dict("list")
    assert pd.read_parquet(places[0])["tile_id"].tolist() == [1, 2]


def test_hours_of_the_day_are_those_of_the_site(measured):
    found = measured.query(
        "SELECT hour(begin) AS hour, sum(hit_steps) AS hits FROM tile_counts "
        "JOIN tiles USING (tile_id) WHERE lanelet_id = 7 GROUP BY hour ORDER BY hour"
    )
    assert found.to_dict("list") == {"hour": [0, 23], "hits": [1, 1]}


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("SELECT til_id FROM hits", 'the query fails: .*; Candidate bindings: "tile_id"'),
        ("SELEC 1", "the query cannot be read: syntax error"),
        ("", "the query has 0 statements, one is needed"),
        ("SELECT 1; SELECT 2", "the query has 2 statements, one is needed"),
        ("SELECT * FROM hitz", "the query names 'hitz', which is no table here"),
        ("SELECT * FROM 'x.parquet'", "the query names 'x.parquet', which is no table here"),
        ("SELECT * FROM 'https://example.org/x.csv'", "which is no table here"),
        ("SELECT * FROM read_csv('/etc/passwd')", "calls read_csv"),
        ("SELECT * FROM query('SELECT 1')", "calls query"),
        ("SELECT (SELECT count(*) FROM read_text('/etc/passwd'))", "calls read_text"),
        ("SELECT current_setting('threads')", "calls current_setting"),
        ("SELECT * FROM duckdb_settings()", "calls duckdb_settings"),
        ("WITH a AS (INSERT INTO hits VALUES (1, 1)) SELECT 1", "holds INSERT, which could write"),
        ("SHOW TABLES", "no table here"),
        ("COPY hits TO 'x.csv'", "is no SELECT"),
        ("ATTACH 'x.db'", "is no SELECT"),
        ("LOAD httpfs", "is no SELECT"),
        ("CALL enable_logging()", "is no SELECT"),
        ("SELECT ?", "the query fails: .*parameters"),
        ("SELECT CAST('x' AS INT)", "the query fails: Conversion Error"),
        ("SELECT " + "(" * 5000 + "1" + ")" * 5000, "the query cannot be read"),
    ],
)
def test_what_is_no_question_is_refused_in_one_line(measured, sql, message):
    with pytest.raises(UsageError, match=message) as refused:
        measured.query(sql)
    assert "\n" not in refused.value.message


def test_a_part_that_may_be_read_cannot_be_written(measured):
    path = part_path(measured.folder, HITS, HOUR)
    before = path.read_bytes()
    target = str(path).replace("'", "''")
    for sql in (
        f"WITH a AS (COPY (SELECT 1) TO '{target}') FROM hits",  # noqa: S608
        f"FROM hits, (WITH a AS (COPY (SELECT 1) TO '{target}') SELECT 1)",
        "SELECT * FROM query('WITH a AS (COPY (SELECT 1) TO ''x'') SELECT 1'), hits",
    ):
        with pytest.raises(UsageError, match=r"holds COPY|calls query"):
            measured.query(sql)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "sql", ["SELECT count(*) FROM range(1000000000000000)", "SELECT * FROM range(1000000000000)"]
)
def test_a_question_without_end_is_given_up(measured, sql):
    with pytest.raises(UsageError, match="the query was given up") as refused:
        measured.query(sql, timeout_s=0.3)
    assert "raise --timeout" in refused.value.hint


def test_a_question_ends_at_once_when_it_is_interrupted(measured):
    signal_it = partial(signal.pthread_kill, threading.main_thread().ident, signal.SIGINT)
    threading.Timer(0.5, signal_it).start()
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        measured.query("SELECT count(*) FROM range(1000000000000000)")
    assert time.monotonic() - begin < 20


def test_a_question_that_needs_too_much_memory_says_so(measured):
    with pytest.raises(UsageError, match="the query needs more memory than it may take"):
        measured.query("SELECT list(range) FROM range(1000000000)", memory="100MB")


def test_variables_of_the_program_are_no_tables(measured):
    frame = pd.DataFrame({"a": [1]})
    assert len(frame) == 1
    with pytest.raises(UsageError, match="names 'frame'"):
        measured.query("SELECT * FROM frame")


def test_only_complete_hours_answer(dataset):
    record_path(dataset.folder, HOUR).unlink()
    assert dataset.query("SELECT count(*) AS n FROM hits")["n"].tolist() == [1]
    assert dataset.query("SELECT count(*) AS n FROM tile_counts")["n"].tolist() == [0]


def test_parts_are_checked_before_they_are_asked(dataset):
    part_path(dataset.folder, HITS, HOUR).unlink()
    with pytest.raises(InputError, match="is missing"):
        dataset.query("SELECT * FROM hits")
    assert dataset.query("SELECT * FROM observed").empty


def test_a_flipped_bit_gives_no_answer(dataset):
    """DuckDB compares no checksums: the sum of a damaged column would be a wrong number."""
    path = part_path(dataset.folder, HITS, HOUR)
    content = bytearray(path.read_bytes())
    content[20] ^= 4
    path.write_bytes(content)
    with pytest.raises(InputError, match="bytes have changed"):
        dataset.query("SELECT sum(step) AS steps FROM hits")


@pytest.mark.parametrize("name", ["tile_counts", "tile_months"])
def test_a_flipped_bit_in_a_table_of_a_date_or_month_gives_no_answer(tmp_path, name):
    later = AFTER + 24 * STEPS_PER_HOUR
    observed = [(tile, step, step + 7 * tile) for tile in range(60) for step in (BEGIN, later)]
    tile, first, last = zip(*observed, strict=True)
    columns = {"tile_id": tile, "first_step": first, "last_step": last}
    hits = {"tile_id": [1, 1], "step": [BEGIN, later]}
    tiles = square_tiles(60)
    dataset = write_dataset(tmp_path / "data", {"hits": hits, "observed": columns}, tiles=tiles)
    records = read_hours(dataset.folder)
    for hour in records:
        TileCounts.of(dataset).update(hour)
    roll_ups(dataset).update(records, records)
    sums = f"SELECT {', '.join(f'sum({c}) AS {c}' for c in TABLES[name].names)} FROM {name}"  # noqa: S608
    (path,) = sorted(dataset.folder.glob(f"{name}/*/*.parquet"))[:1]
    whole, right = path.read_bytes(), dataset.query(sums)
    footer = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
    wrong = 0
    for place in range(4, footer, 17):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        with suppress(InputError):
            wrong += not dataset.query(sums).equals(right)
    assert wrong == 0


def test_a_check_reads_the_tile_counts(dataset):
    dataset.check()
    path = part_path(dataset.folder, TABLES["tile_counts"], HOUR)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x")
    with pytest.raises(InputError, match="tile_counts") as refused:
        dataset.check()
    assert "remove it" in refused.value.hint


def test_hours_that_are_made_meanwhile_are_said(dataset):
    from gis_radar.dataset.questions.queries import run_query

    record = record_path(dataset.folder, HOUR)
    state = record.stat()
    with (
        pytest.raises(InputError, match="hours were made again meanwhile"),
        run_query(*dataset.queried_sites(), "SELECT * FROM hits", timeout_s=60.0, memory="1GB") as (
            _,
            batches,
        ),
    ):
        assert sum(len(each) for each in batches) == 3
        os.utime(record, ns=(state.st_atime_ns, state.st_mtime_ns + 1_000_000))
