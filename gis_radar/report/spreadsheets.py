"""The tables of a report as CSV that a spreadsheet opens without taking text for a formula."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from datetime import datetime
from numbers import Number
from pathlib import Path
from typing import Any

import pandas as pd

from gis_radar.poses.pose import ANGLES, POSITION, View
from gis_radar.quality import Quality
from gis_radar.report.folder import Results
from gis_radar.report.lanes import LaneTally
from gis_radar.report.tables import how_found, lost_of
from gis_radar.report.words import Clock, direction

# What makes a spreadsheet take a cell for a formula (OWASP), in ASCII and in full width.
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")

Row = Sequence[Any]


def safe(cell: Any) -> Any:
    """Return a cell as it is written: numbers stay, text never begins a formula."""
    if cell is None or cell is pd.NaT:
        return ""
    if isinstance(cell, Number):
        return "" if isinstance(cell, float) and math.isnan(cell) else cell
    text = str(cell)
    return f"'{text}" if text.lstrip(" ").startswith(FORMULA) else text


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Row]) -> None:
    """Write a table as CSV in UTF-8, with commas and points."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\r\n")
        writer.writerow([safe(name) for name in header])
        writer.writerows([safe(cell) for cell in row] for row in rows)


def write_lanes(path: Path, table: pd.DataFrame, clock: Clock) -> None:
    """Write all lanes: one row each, shares from 0 to 1, empty where not observed."""
    header = (
        "lane", "lanelets", "subtype", "leads_to", "length_m", "observed_m", "occupied_tile_s",
        "observed_tile_s", "occupancy", "busiest_spot", "busiest_spot_m", "over_20_percent_m",
        "busiest_begin_utc", "busiest_begin_local", "busiest_end_utc", "busiest_occupancy",
    )  # fmt: skip
    write_csv(path, header, (_lane(row, clock) for _, row in table.iterrows()))


def _lane(row: pd.Series, clock: Clock) -> Row:
    begin, end = row["busiest_begin"], row["busiest_end"]
    never = pd.isna(begin)
    lanelets = row["lanelets"]
    return (
        int(row["lane"]),
        lanelets[0] if len(lanelets) == 1 else " ".join(map(str, lanelets)),
        row["subtype"],
        direction(row["east_m"], row["north_m"]),
        round(float(row["length_m"]), 2),
        round(float(row["observed_m"]), 2),
        round(float(row["occupied_s"]), 2),
        round(float(row["observed_s"]), 2),
        round(float(row["occupancy"]), 6),
        round(float(row["busiest_spot"]), 6),
        round(float(row["busiest_spot_m"]), 2),
        round(float(row["busy_m"]), 2),
        "" if never else utc(begin),
        "" if never else clock.iso(begin),
        "" if never else utc(end),
        round(float(row["busiest_occupancy"]), 6),
    )


def write_lane_intervals(
    path: Path, tally: LaneTally, spans: Sequence[tuple[datetime, datetime]], clock: Clock
) -> None:
    """Write one row a lane and interval, also where nothing was hit or observed."""
    header = (
        "lane", "begin_utc", "end_utc", "begin_local",
        "occupied_tile_s", "observed_tile_s", "occupancy",
    )  # fmt: skip
    rows = (
        _interval(lane.number, times, occupied[i], observed[i])
        for (begin, end), occupied, observed in zip(
            spans, tally.occupied, tally.observed, strict=True
        )
        for times in [(utc(begin), utc(end), clock.iso(begin))]
        for i, lane in enumerate(tally.lanes)
    )
    write_csv(path, header, rows)


def _interval(number: int, times: Row, occupied: float, observed: float) -> Row:
    known = observed > 0
    return (
        number,
        *times,
        round(float(occupied), 2) if known else "",
        round(float(observed), 2),
        round(float(occupied / observed), 6) if known else "",
    )


def write_sensors_table(path: Path, results: Results) -> None:
    """Write the poses with their standard deviations, and who has none."""
    names = (*POSITION, *ANGLES)
    header = (
        "sensor", "crs", *names, *(f"sigma_{name}" for name in names),
        "azimuth_deg", "elevation_deg", "min_range_m", "max_range_m", "how_found",
    )  # fmt: skip
    rows: list[Row] = []
    for pose in results.poses:
        sigma = pose.evidence.get("sigma")
        known = sigma if isinstance(sigma, dict) else {}
        view = pose.view or View()
        rows.append(
            (
                pose.sensor,
                pose.as_dict()["crs"],
                *(round(getattr(pose, name), 4) for name in names),
                *(_rounded(known.get(name)) for name in names),
                *(view.azimuth_deg, view.elevation_deg, view.min_range_m, view.max_range_m),
                how_found(pose),
            )
        )
    blank = [""] * (len(header) - 2)
    rows += [(name, *blank, f"no result: {why}") for name, why in lost_of(results).items()]
    write_csv(path, header, rows)


def write_quality(path: Path, quality: Quality) -> None:
    """Write the table of :func:`gis_radar.measure_quality`, a row a sensor and hour."""
    table = quality.table
    rows = (
        tuple(utc(cell) if isinstance(cell, pd.Timestamp) else cell for cell in row)
        for row in table.itertuples(index=False, name=None)
    )
    write_csv(path, list(table.columns), rows)


def utc(moment: datetime) -> str:
    """Return a time as ISO 8601 with Z."""
    text = pd.Timestamp(moment).tz_convert("UTC").isoformat(timespec="milliseconds")
    return text.removesuffix("+00:00").removesuffix(".000") + "Z"


def _rounded(value: Any) -> Any:
    return round(float(value), 4) if isinstance(value, int | float) else ""
