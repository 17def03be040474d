"""`gis-radar query` and `gis-radar dataset`."""

import json

import pandas as pd
import pyarrow as pa
import pytest
from datasets import BEGIN, write_dataset

from gis_radar.dataset.questions.answers import csv_texts, json_texts


@pytest.fixture
def folder(tmp_path):
    big = 9_007_199_254_740_993
    rows = {
        "hits": {"tile_id": [1, 2], "step": [BEGIN, BEGIN + 1]},
        "vehicles": {
            "vehicle": [5], "first_step": [BEGIN], "last_step": [BEGIN + 9], "length_m": [4.5],
            "width_m": [1.8], "length_sigma_m": [0.5], "p_exists": [0.99], "p_heavy": [0.1],
            "lanelets": [[big, 7]],
        },
    }  # fmt: skip
    rows["vehicles"]["lanelets"] = pd.Series(rows["vehicles"]["lanelets"]).to_numpy()
    return write_dataset(tmp_path / "data", rows).folder


def last_line(answer):
    return json.loads(answer[1].splitlines()[-1])


def test_rows_are_shown_as_they_are(run, folder):
    code, out, _ = run("query", folder, "SELECT tile_id, time, NULL AS x FROM hits ORDER BY step")
    assert code == 0
    assert "2023-11-14T22:00:00.05Z" in out
    code, out, _ = run("query", folder, "SELECT unnest(lanelets) AS lanelet_id FROM vehicles")
    assert "9007199254740993" in out


def test_no_number_or_time_is_broken_by_many_columns(run, folder):
    columns = (f"9007199254740993 AS number_{k}, time AS time_{k}" for k in range(20))
    code, out, _ = run("query", folder, f"FROM hits SELECT {', '.join(columns)} LIMIT 1")
    assert code == 0
    assert out.count("9007199254740993") == out.count("2023-11-14T22:00:00Z") == 20


def test_rows_are_objects_for_programs(run, folder):
    sql = "SELECT tile_id, time, lanelets FROM hits, vehicles ORDER BY step"
    found = last_line(run("query", folder, sql, "--limit", "1", "--json"))
    assert found["summary"] == {
        "total": 2,
        "rows": [
            {"tile_id": 1, "time": "2023-11-14T22:00:00Z", "lanelets": ["9007199254740993", "7"]}
        ],
    }


def test_ids_of_the_map_are_text(run, folder):
    """As in all JSON; what has such a name and is no whole number stays as it is."""
    sql = (
        "SELECT 9007199254740993 AS lane, NULL::BIGINT AS lanelet_id, {'a': 1} AS from_lane, "
        "0.5::DOUBLE AS to_lane FROM hits LIMIT 1"
    )
    (row,) = last_line(run("query", folder, sql, "--json"))["summary"]["rows"]
    assert row == {
        "lane": "9007199254740993", "lanelet_id": None, "from_lane": '{"a": 1}', "to_lane": 0.5
    }  # fmt: skip


def test_numbers_are_such_as_json_holds(run, folder):
    sql = "SELECT sum(tile_id) AS a, 0.5::DECIMAL(3, 1) AS b, 'nan'::DOUBLE AS c FROM hits"
    rows = last_line(run("query", folder, sql, "--json"))["summary"]["rows"]
    assert rows == [{"a": 3, "b": 0.5, "c": None}]


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_answers_are_written(run, folder, tmp_path, kind):
    path = tmp_path / f"answer.{kind}"
    code, *_ = run("query", folder, "SELECT time, lanelets FROM hits, vehicles", "-o", path)
    assert code == 0
    found = pd.read_csv(path) if kind == "csv" else pd.read_parquet(path)
    assert pd.to_datetime(found["time"]).max() == pd.Timestamp("2023-11-14T22:00:00.05Z")
    wanted = "9007199254740993 7" if kind == "csv" else [9_007_199_254_740_993, 7]
    assert list(found["lanelets"].iloc[0]) == list(wanted)


def test_days_times_and_structs_are_text(run, folder, tmp_path):
    sql = "SELECT time::DATE AS day, {'a': 1} AS pair, INTERVAL 1 DAY AS span FROM hits LIMIT 1"
    (row,) = last_line(run("query", folder, sql, "--json"))["summary"]["rows"]
    assert (row["day"], json.loads(row["pair"])) == ("2023-11-14", {"a": 1})
    for name in ("q.csv", "q.parquet"):
        written = sql if name == "q.csv" else sql.replace(", INTERVAL 1 DAY AS span", "")
        assert run("query", folder, written, "-o", tmp_path / name)[0] == 0
    assert pd.read_csv(tmp_path / "q.csv")["day"].tolist() == ["2023-11-14"]


def test_text_that_begins_like_a_formula_is_text_for_spreadsheets(run, folder, tmp_path):
    """Names of streets are those of anybody's map."""
    sql = "SELECT '=1+1' AS a, ' @x' AS b, '\uff1d1' AS c, 'a=1' AS d, -1.5 AS e"
    assert run("query", folder, sql, "-o", tmp_path / "q.csv")[0] == 0
    row = (tmp_path / "q.csv").read_text(encoding="utf-8").splitlines()[1]
    assert row == '"\'=1+1","\' @x","\'\uff1d1","a=1",-1.5'


def test_a_number_over_64_bits_is_named(run, folder):
    code, _, err = run("query", folder, "SELECT 9223372036854775807::HUGEINT * 2 AS x")
    assert code == 2
    assert "over 64 bits" in err


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (
            ("SELECT * FROM range(10000000000000)", "--timeout", "0.2s"),
            2,
            "given up after 0.2 s",
        ),
        (("SELECT 1", "-o", "x.txt"), 2, "x.txt: an answer is written as .csv or .parquet"),
        (("SELECT 1 AS a, 2 AS a",), 2, "the query has two columns 'a' (name one with AS)"),
        (("SELECT * FROM lanes",), 3, "tiles.gpkg"),
        (
            ("SELECT list(range) FROM range(1000000000)", "--memory", "90MB"),
            2,
            "needs more memory",
        ),
        (("SELECT 1", "--memory", "much"), 2, "much"),
        (("SELECT 1", "--limit", "1" + "0" * 20), 2, "is not in the range"),
        (("SELECT union_value(a := 1) AS u", "-o", "u.parquet"), 2, "u.parquet: cannot hold a"),
    ],
)
def test_errors_are_one_line(run, folder, words, code, message):
    answer = run("query", folder, *words)
    assert answer[0] == code
    assert message in answer[2]
    assert len(answer[2].splitlines()) == 1


def test_an_answer_that_is_given_up_leaves_no_file(run, folder, tmp_path):
    path = tmp_path / "answer.csv"
    sql = "SELECT * FROM range(1000000000000)"
    assert run("query", folder, sql, "-o", path, "--timeout", "0.3s")[0] == 2
    assert [each.name for each in tmp_path.iterdir()] == ["data"]


def test_a_dataset_says_what_it_holds(run, folder):
    found = last_line(run("dataset", folder, "--check", "--json"))["summary"]
    assert found["hits"] == 2
    assert found["vehicles"] == 1
    assert run("dataset", folder.parent)[0] == 3


def test_times_are_no_finer_than_needed():
    times = pa.array([0, 1_500_000, 60_000_000, 1], pa.timestamp("us", "UTC"))
    shown = json_texts(pa.table({"t": times}))["t"].to_pylist()
    assert shown == [
        "1970-01-01T00:00:00Z", "1970-01-01T00:00:01.5Z", "1970-01-01T00:01:00Z",
        "1970-01-01T00:00:00.000001Z",
    ]  # fmt: skip
    assert csv_texts(pa.table({"a": [[1, 2], []]}))["a"].to_pylist() == ["1 2", ""]
