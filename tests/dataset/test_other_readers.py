"""Other programs read the folder as it lies there: DuckDB's command line, pandas, Polars."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest
from datasets import BEGIN, HOUR, write_dataset

from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset import TILE_COUNTS
from gis_radar.dataset.files.tables import HOUR_TABLES, TABLES

DUCKDB = Path(sys.executable).with_name("duckdb")
BIG = 9_007_199_254_740_993


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Rows in two hours, of every kind of column."""
    rng = np.random.default_rng(0)
    tables = {}
    for table in HOUR_TABLES:
        if table.span is None:
            continue
        values = {}
        for column in table.columns:
            whole = rng.integers(0, 500, 400)
            kind = str(column.type)
            values[column.name] = {
                "string": np.where(whole > 250, "R1", "R2"), "bool": whole > 250,
                "float": whole / 7,
            }.get(kind, whole)  # fmt: skip
            if column.name in table.span:
                values[column.name] = BEGIN + np.arange(400) * 300
            if column.name in {"time_us", "vehicle"}:
                values[column.name] = np.arange(400)
            if kind.startswith("list"):
                values[column.name] = pd.Series([[BIG, 7]] * 400).to_numpy()
            if column.nullable and kind == "int64":
                values[column.name] = np.ma.MaskedArray(np.full(400, BIG), whole > 250)
        tables[table.name] = pd.DataFrame(values).sort_values(list(table.order))
    for name in ("observed", "visible", "occupied"):
        tables[name]["last_step"] = tables[name]["first_step"] + 99
    return write_dataset(tmp_path_factory.mktemp("readers") / "data", tables)


def asked(folder, sql):
    """Ask DuckDB's command line from another folder."""
    command = [DUCKDB, "-json", "-c", sql]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd="/")
    return json.loads(done.stdout)


@pytest.mark.parametrize("table", [*HOUR_TABLES, TILE_COUNTS], ids=lambda table: table.name)
def test_all_read_the_same(dataset, table):
    folder = dataset.folder / table.name
    mine = [rows for batch in dataset.batches(table) for rows in batch.to_pylist()]
    for row in mine:
        row.pop("first_step", None) if table is TILE_COUNTS else None
    names = table.names
    polars = pl.read_parquet(folder / "**/*.parquet").select(names).to_dicts()
    frame = pd.read_parquet(folder, dtype_backend="pyarrow")[names].astype(object)
    pandas = frame.where(frame.notna(), None).to_dict("records")
    for row in pandas:
        row.update({name: list(map(int, row[name])) for name in {"lanelets"} & {*names}})
    columns = ", ".join(names)
    sql = f"SELECT {columns} FROM read_parquet('{folder}/*/*.parquet')"  # noqa: S608
    duckdb = asked(folder, sql)
    for theirs in (polars, pandas, duckdb):
        assert comparable(theirs) == comparable(mine)


def comparable(rows):
    """Give rows in one order, floats as far as JSON of DuckDB has them."""
    values = [[round(v, 3) if isinstance(v, float) else v for v in row.values()] for row in rows]
    return sorted(map(repr, values))


def test_one_question_has_one_answer(dataset):
    folder = dataset.folder / "tile_counts"
    sql = "SELECT interval, sum(hit_steps)::BIGINT AS hits FROM {} GROUP BY 1 ORDER BY 1"
    by_cli = asked(folder, sql.format(f"read_parquet('{folder}/*/*.parquet')"))
    frame = pd.read_parquet(folder).groupby("interval")["hit_steps"].sum()
    frame_of_polars = (
        pl.scan_parquet(folder / "**/*.parquet")
        .group_by("interval")
        .agg(pl.col("hit_steps").cast(pl.Int64).sum().alias("hits"))
        .sort("interval")
        .collect()
    )
    mine = dataset.query(sql.format("tile_counts")).to_dict("records")
    assert mine == by_cli == frame_of_polars.to_dicts()
    assert mine == [{"interval": i, "hits": int(n)} for i, n in frame.items()]


def test_dates_are_those_of_the_folders(dataset):
    found = pd.read_parquet(dataset.folder / "hits")
    assert set(map(str, found["date"].unique())) == {"2023-11-14"}
    step = found["step"].to_numpy()
    assert {HOUR, HOUR + 1} == set((step // STEPS_PER_HOUR).tolist())
    assert set(TABLES) > {"hits"}
