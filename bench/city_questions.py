"""Time to answer questions over months: a street over a year, the map of a month.

    python bench/city_questions.py [--days 365] [--lane-tiles 12000] [--tiles 50000]

Days are drawn (`drawn_days.py`), without exact tables, as after `keep`. Each measurement is a
process of its own on one core; times are CPU time without imports.

- Year: a street by hour of the day, Monday to Friday: from the roll-up, the first time in a process
  and again; from the tables of dates; beside pandas and DuckDB on the same tables.
- Month: the heat map of a month of many tiles, made, and written as GeoPackage and GeoTIFF.

Exit code 1 where a figure misses its target.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

from drawn_days import roll_up, write_days
from figures import TARGET, TIME_CHANCE, Figure, report, run_alone

FIRST_TARGET_S, AGAIN_TARGET_S, MAP_TARGET_S = 1.0, 0.03, 15.0
MONTH = "2026-01"
START = """
import json, sys, time
import gis_radar as gr
import duckdb, geopandas, numba, pandas as pd, pyarrow.parquet, scipy.spatial
import gis_radar.dataset.questions.profiles, gis_radar.products
def spent_s(work):
    begin = time.process_time()
    work()
    return time.process_time() - begin
"""
OURS = (
    START
    + """
dataset = gr.open_dataset(sys.argv[1])
def ask():
    dataset.profile("Street 3", by="hour", days="Mo-Fr")
print(json.dumps({"first_s": spent_s(ask), "again_s": min(spent_s(ask) for _ in range(5))}))
"""
)
PANDAS = (
    START
    + """
def ask():
    columns = ["lane", "interval", "date", "volume", "flow", "density", "visible_km_h", "occupancy"]
    rows = pd.read_parquet(sys.argv[1] + "/lane_measures", columns=columns)
    date = pd.to_datetime(rows["date"].astype(str))
    begin = (date + pd.to_timedelta(15 * rows["interval"], unit="min")).dt.tz_localize("UTC")
    begin = begin.dt.tz_convert("Europe/Berlin")
    rows = rows[begin.dt.day_of_week < 5]
    rows.groupby(["lane", begin.dt.hour])[columns[3:]].mean()
print(json.dumps({"s": spent_s(ask)}))
"""
)
DUCKDB = (
    START  # noqa: S608 - its own SQL
    + """
def ask():
    duckdb.sql("SET threads = 1")
    duckdb.sql("SET TimeZone = 'Europe/Berlin'")
    duckdb.sql(
        "SELECT lane, hour(b), avg(volume), sum(flow * visible_km_h), sum(density * visible_km_h) "
        "FROM (SELECT *, to_timestamp(epoch(date) + 900 * interval) AS b FROM "
        f"read_parquet('{sys.argv[1]}/lane_measures/*/*.parquet', hive_types = {{'date': DATE}})) "
        "WHERE isodow(b) < 6 GROUP BY ALL"
    ).fetchall()
print(json.dumps({"s": spent_s(ask)}))
"""
)
MAP = (
    START
    + """
from pathlib import Path
from gis_radar.products.heatmap.layers import write_package
from gis_radar.products.heatmap.raster import write_raster
from gis_radar.base import QUIET
out = Path(sys.argv[2])
made = []
make_s = spent_s(lambda: made.append(gr.make_heatmap(sys.argv[1], month=sys.argv[3])))
package_s = spent_s(lambda: write_package(made[0], out / "heatmap.gpkg", QUIET))
raster_s = spent_s(lambda: write_raster(made[0], out / "heatmap.tif", QUIET))
print(json.dumps({"make_s": make_s, "package_s": package_s, "raster_s": raster_s}))
"""
)


def timed(what: str, ours: float, size: str, unit: str = "s", **peer: Any) -> Figure:
    """Return a figure of time or memory."""
    return Figure(what=what, ours=ours, unit=unit, size=size, chance=TIME_CHANCE, **peer)


def year(folder: Path, tiles: int, days: int) -> Iterator[Figure]:
    """Yield the figures of a street over a year."""
    dataset = write_days(folder, tiles=tiles, days=days, counts=False, dropped=True)
    size = f"{days} days, {tiles // 200} lanes"
    plain = run_alone("-c", OURS, folder).lines[-1]
    roll_up(dataset)
    rolled = run_alone("-c", OURS, folder).lines[-1]
    pandas_s, duckdb_s = (run_alone("-c", code, folder).lines[-1]["s"] for code in (PANDAS, DUCKDB))
    again = rolled["again_s"]
    for what, ours, target in (
        ("first in a process", rolled["first_s"], FIRST_TARGET_S),
        ("again", again, AGAIN_TARGET_S),
    ):
        name = f"profile of a street, {what}, from the roll-up"
        yield timed(name, ours, size, peer=target, peer_name=TARGET)
    for what, ours in (
        ("profile of a street from the tables of dates", plain["first_s"]),
        ("pandas on the tables of dates", pandas_s),
        ("DuckDB on the tables of dates", duckdb_s),
    ):
        yield timed(what, ours, size, peer=again, peer_name="from the roll-up again")


def month(folder: Path, tiles: int) -> Iterator[Figure]:
    """Yield the figures of the map of a month."""
    dataset = write_days(folder / "data", tiles=tiles, days=31, in_sight=1.0, dropped=True)
    roll_up(dataset)
    ran = run_alone("-c", MAP, folder / "data", folder, MONTH)
    size, spent = f"{tiles:,} tiles", ran.lines[-1]
    what = "map of a month, with GeoPackage and COG"
    yield timed(what, sum(spent.values()), size, peer=MAP_TARGET_S, peer_name=TARGET)
    yield timed("map of a month, not written", spent["make_s"], size)
    yield timed("map of a month, most memory", ran.peak_mib, size, "MiB")


def main() -> None:
    """Measure, and judge."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--days", type=int, default=365, help="of the year")
    parser.add_argument("--lane-tiles", type=int, default=12_000, help="of the year's site")
    parser.add_argument("--tiles", type=int, default=50_000, help="of the map")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "month").mkdir()
        parts = (
            year(place / "year", options.lane_tiles, options.days),
            month(place / "month", options.tiles),
        )
        report("city-questions", chain(*parts))


if __name__ == "__main__":
    main()
