"""From a folder of results to a report of them: facts, lanes and quality in words and tables."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gis_radar.errors import OutputError, UsageError
from gis_radar.files import whole_files
from gis_radar.heatmap import HeatMap
from gis_radar.heatmap.covering import mean_coverage, surest
from gis_radar.notebooks import card
from gis_radar.progress import QUIET, Reporter
from gis_radar.quality import Quality, measure_quality
from gis_radar.quality.quality import GOOD
from gis_radar.report import names
from gis_radar.report.content import (
    NOTHING,
    THIN,
    WORDS,
    Chapter,
    Column,
    Content,
    Figure,
    MapSeries,
    Table,
    Terms,
    count,
    direction,
    figure_text,
    percent,
    text_rows,
    utc,
    write_csv,
)
from gis_radar.report.lanes import (
    LaneSums,
    lane_table,
    shown_of,
    sum_by_lane,
    write_lane_intervals,
    write_lanes,
)
from gis_radar.report.maps import draw_hits, draw_maps, draw_plan, draw_sights, lay_out
from gis_radar.report.pages import page_of, write_pdf
from gis_radar.report.results import (
    NOT_KNOWN,
    Results,
    made_by,
    pose_figures,
    read_results,
    sensor_table,
    settings_of,
    sources_of,
    write_sensor_table,
)
from gis_radar.steps import Clock, zone_of

NAN = float("nan")
SHORT_S = 900.0  # usual counts are of 15 minutes; shorter ones hold few cycles of a signal

MOST_LANES, MOST_HOURS = 150, 168  # rows of tables as read; the CSV files hold all


class _Findings(NamedTuple):
    """What page, paper and tables are made of."""

    results: Results
    title: str
    clock: Clock
    quality: Quality | None  # what sensors delivered; None where that is not known
    lanes: LaneSums
    table: pd.DataFrame  # the lanes over the whole time, from `lane_table`


@dataclass(frozen=True, kw_only=True)
class Report:
    """A written report: its files and figures.

    Parameters
    ----------
    outputs : sequence of Path
        The files: the page, the paper, and the tables.
    summary : dict
        Figures worth a look.
    """

    outputs: Sequence[Path]
    summary: dict[str, Any]

    def __repr__(self) -> str:
        page = self.outputs[0]
        return f"Report({self.summary['title']!r}, {len(self.outputs)} files: {page}, ...)"

    def _repr_html_(self) -> str:
        files = {"files": ", ".join(path.name for path in self.outputs)}
        return card(f"Report in {self.outputs[0].parent}", self.summary | files)


def write_report(
    folder: str | Path,
    *,
    output: str | Path | None = None,
    title: str | None = None,
    timezone: str | None = None,
    occupancies: Sequence[str | Path] = (),
    reporter: Reporter = QUIET,
) -> Report:
    """Write a report for people without QGIS: `report.html`, `report.pdf`, and tables as CSV.

    The page opens without a network and asks for nothing; it needs no script but for the slider.
    What the folder does not hold is named as not known. The same results give the same files.

    Parameters
    ----------
    folder : str or Path
        Results of `gis-radar run` or `gis-radar demo`, or the folder of a heat map.
    output : str or Path, optional
        Folder that the report goes to; by default `folder`.
    title : str, optional
        By default that of the site or heat map, or the name of the folder.
    timezone : str, optional
        Whose clocks the report's times follow, such as Europe/Berlin; by default the site's, or
        those of the heat map's picture.
    occupancies : sequence of str or Path
        Folders that the heat map was made of, where they are not in `folder`.
    reporter : Reporter
        Where progress goes.

    Returns
    -------
    Report

    Raises
    ------
    InputError
        If the folder holds no heat map, or a damaged one.
    UsageError
        If there is no such time zone.
    OutputError
        If the report cannot be written.
    """
    folder = Path(folder)
    if title is not None and not title.strip():
        raise UsageError("the title is empty", hint="leave it out, or give the name of the site")
    results = read_results(folder, [Path(each) for each in occupancies], reporter=reporter)
    heat = results.heat
    zone = timezone or str(results.site.get("time_zone") or heat.labels.timezone)
    named = str(results.site.get("title") or heat.labels.title or folder.resolve().name)
    clock, sums, picture = _clock(heat, zone), sum_by_lane(heat), lay_out(heat)
    table = lane_table(heat, sums)
    found = _Findings(
        results=results,
        title=title or named,
        clock=clock,
        quality=_quality(results, zone, reporter),
        lanes=sums,
        table=table,
    )
    maps = draw_maps(results, picture, sums, clock, reporter)
    hits = [draw_hits(results, picture, sums)] if heat.measure == "coverage" else []
    content = _content(found, maps, draw_plan(heat.tiles, picture, sums.lanes, table), hits)
    outputs = _write(folder if output is None else Path(output), found, content, reporter)
    return Report(outputs=outputs, summary=_summary(found, content))


def _clock(heat: HeatMap, timezone: str) -> Clock:
    """Return the site's clock: to the second where an interval does not begin at a minute."""
    edges = [each for span in heat.timeline.spans() for each in span]
    fine = any(each.second or each.microsecond for each in edges)
    begin, end = heat.whole.span()
    return Clock(
        zone=zone_of(timezone), first=min(edges[0], begin), last=max(edges[-1], end),
        to_seconds=fine,
    )  # fmt: skip


def _quality(results: Results, timezone: str, reporter: Reporter) -> Quality | None:
    occupancy = results.occupancy
    if occupancy is None or not any(True for _ in occupancy.frame_log(occupancy.sensors)):
        return None
    return measure_quality(occupancy, timezone=timezone, reporter=reporter)


def _write(place: Path, found: _Findings, content: Content, reporter: Reporter) -> list[Path]:
    """Write all files, which appear together or not at all."""
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(
            f"{place}: cannot be written: {reason}", hint="name a folder for the report"
        ) from error
    writers = _writers(found, content)
    before = [place / name for name in names.REPORT_FILES] if (place / names.PAGE).is_file() else []
    with whole_files(place / names.PAGE) as (private, places):
        for done, (name, write) in enumerate(writers.items(), start=1):
            write(private / name)
            places[private / name] = place / name
            reporter.progress("writing the report", done, len(writers))
    for path in before:  # what the last report had and this one has not
        if path.name not in writers:
            path.unlink(missing_ok=True)
    return [place / name for name in writers]


def _writers(found: _Findings, content: Content) -> dict[str, Callable[[Path], object]]:
    """Return the writer of each file."""
    clock, heat, quality = found.clock, found.results.heat, found.quality
    writers: dict[str, Callable[[Path], object]] = {
        names.PAGE: lambda path: path.write_text(page_of(content), encoding="utf-8", newline="\n"),
        names.PAPER: lambda path: write_pdf(content, path),
        names.LANES: lambda path: write_lanes(path, found.table, clock, heat.measure),
        names.LANES_BY_INTERVAL: lambda path: write_lane_intervals(path, heat, found.lanes, clock),
        names.SENSORS: lambda path: write_sensor_table(path, found.results),
    }
    if quality is not None:
        writers[names.QUALITY] = lambda path: _write_quality(path, quality)
    return writers


def _write_quality(path: Path, quality: Quality) -> None:
    """Write the table of :func:`gis_radar.measure_quality`, a row a sensor and hour."""
    rows = (
        tuple(utc(cell) if isinstance(cell, pd.Timestamp) else cell for cell in row)
        for row in quality.table.itertuples(index=False, name=None)
    )
    write_csv(path, list(quality.table.columns), rows)


def _summary(found: _Findings, content: Content) -> dict[str, Any]:
    """Return the figures as numbers, None where not known; the page has them in words."""
    begin, end = found.results.heat.whole.span()
    return {
        "title": content.title,
        "begin": utc(begin),
        "end": utc(end),
        "timezone": str(found.clock.zone),
        "pictures": len(content.map.frames) + 1,
        "sensors": found.results.sensors,
        **_totals(found),
        "remarks": list(content.remarks),
    }


def _content(found: _Findings, maps: MapSeries, plan: Figure, hits: Sequence[Figure]) -> Content:
    """Put the findings into words."""
    results, clock = found.results, found.clock
    begin, end = results.heat.whole.span()
    return Content(
        title=found.title,
        subtitle=clock.whole(begin, end),
        zone=clock.name,
        until=end,
        intro=WORDS[results.heat.measure].intro,
        facts=_facts(found),
        remarks=_remarks(results, found.quality),
        map=maps,
        chapters=_chapters(found, plan, hits),
        made_by=made_by(),
        measure=results.heat.measure,
    )


def _chapters(found: _Findings, plan: Figure, hits: Sequence[Figure]) -> list[Chapter]:
    """Return what follows the map."""
    results, clock = found.results, found.clock
    intervals = len(results.heat.timeline) > 1
    figures = pose_figures(results)
    lanes = _lanes(found.table, clock, results.heat.measure, intervals=intervals)
    sensors = sensor_table(results, figures=len(figures))
    quality = _quality_table(found.quality, clock, _tracks(results.traffic))
    sources = [settings_of(results), sources_of(results)]
    return [
        Chapter("lanes", "Lanes", [plan, lanes], 190.0),
        Chapter("sensors", "Sensors", [sensors, *draw_sights(results), *figures], 60.0),
        Chapter("quality", "What the numbers rest on", [quality]),
        *([Chapter("hits", "Diagnosis: radar hits", hits, 150.0)] if hits else []),
        Chapter("settings", "Settings and sources", sources, 70.0),
        Chapter("words", "What the words mean", [_terms(results.heat.measure)]),
    ]


def _terms(measure: str) -> Terms:
    """Return what the words of a report mean, of coverage only where it shows that."""
    text = files("gis_radar.report").joinpath("definitions.toml").read_text(encoding="utf-8")
    groups = tomllib.loads(text)
    chosen = [name for name in groups if measure == "coverage" or name != "coverage"]
    return Terms(tuple(pair for name in chosen for pair in groups[name].items()))


def _totals(found: _Findings) -> dict[str, Any]:
    """Count the totals of the whole time; the busiest lane is None where nothing was in any."""
    heat, table, measure = found.results.heat, found.table, found.results.heat.measure
    shares, length_m = shown_of(heat), heat.tiles["length_m"].to_numpy(np.float64)
    seen, words = shares.base_s > 0, WORDS[measure]
    hit = not table.empty and table["share"].iloc[0] > 0  # the busiest stands first
    totals = {
        "lanes": len(table),
        f"lanes_{words.base}": int(table["share"].notna().sum()),
        "lane_length_m": round(float(length_m.sum()), 2),
        f"lane_length_{words.base}_m": round(float(length_m[seen].sum()), 2),
        f"tiles_{words.base}": int(seen.sum()),
        f"tiles_{words.touched}": int(np.count_nonzero(shares.part_s[seen])),
        "busiest_lane": int(table["lane"].iloc[0]) if hit else None,
        f"busiest_lane_{measure}": round(float(table["share"].iloc[0]), 6) if hit else None,
        "busiest_lane_se": round(float(table["share_se"].iloc[0]), 6) if hit else None,
    }
    known = heat.coverage_shares()
    if known is None or not seen.any():
        totals.pop("busiest_lane_se")
        return totals
    top = surest(known.coverage, known.coverage_se)
    mean, error = mean_coverage(heat.tiles, known)
    return totals | {
        "mean_coverage": round(mean, 6),
        "mean_coverage_se": round(error, 6),
        "highest_coverage": round(float(known.coverage[top]), 6),
        "highest_coverage_se": round(float(known.coverage_se[top]), 6),
        **found.results.traffic,
    }


def _facts(found: _Findings) -> list[tuple[str, str]]:
    """Return the figures at the top."""
    total, sensors, measure = _totals(found), found.results.sensors, found.results.heat.measure
    words = WORDS[measure]
    shown = {name: figure_text(value) for name, value in total.items() if value is not None}
    busiest = f"none was {words.touched}"
    if total["busiest_lane"] is not None:
        share = total[f"busiest_lane_{measure}"]
        busiest = (
            f"No. {total['busiest_lane']}: {percent(share, off=total.get('busiest_lane_se', NAN))}"
        )
    facts = [
        ("Sensors", str(len(sensors)) if sensors else NOT_KNOWN),
        (f"Lanes {words.base}", f"{total[f'lanes_{words.base}']} of {total['lanes']}"),
        (
            f"Lane length {words.base}",
            f"{shown[f'lane_length_{words.base}_m']} of {shown['lane_length_m']}{THIN}m",
        ),
        (f"Tiles {words.touched}",
         f"{shown[f'tiles_{words.touched}']} of {shown[f'tiles_{words.base}']}"),
        ("Busiest lane", busiest),
    ]  # fmt: skip
    if "mean_coverage" not in total:
        return facts
    highest, mean = "highest_coverage", "mean_coverage"
    facts[3] = ("Mean coverage", percent(total[mean], off=total[f"{mean}_se"]))
    return [*facts, ("Busiest spot", percent(total[highest], off=total[f"{highest}_se"]))]


def _tracks(traffic: dict[str, int]) -> str:
    """Return in how many tracks vehicles were followed, and that these are no count of them."""
    if "vehicles" not in traffic:
        return ""
    tracks, heavy = count(traffic["vehicles"], "track"), figure_text(traffic["heavy"])
    return (
        f"Coverage comes from {tracks}, {heavy} of them of heavy vehicles. These are no count of "
        "vehicles: a track may be a piece of a vehicle's way."
    )


def _remarks(results: Results, quality: Quality | None) -> list[str]:
    """Return what to know before reading on."""
    begin, end = results.heat.whole.span()
    lasts = (end - begin).total_seconds()
    remarks = [f"No result for sensor {name}: {why}" for name, why in results.lost.items()]
    if lasts < SHORT_S:
        remarks.append(
            f"Measured for {lasts:.0f} seconds only: a few cycles of a signal, and no usual day"
        )
    if quality is not None:
        remarks += [f"Sensor {line}" for line in quality.warnings()]
    return [*remarks, *results.warnings, *results.missing]


def _lanes(table: pd.DataFrame, clock: Clock, measure: str, *, intervals: bool) -> Table:
    """Return the lanes with a share as they are read, from what `lane_table` returns."""
    seen, base = table[table["share"].notna()], WORDS[measure].base
    shown = seen.head(MOST_LANES)
    columns = _lane_columns(clock, measure)
    columns = columns if intervals else columns[:-2]
    note = "Where lanes cross, their tiles overlap, and a vehicle there counts on each."
    if measure == "coverage":
        note = f"± is the standard error. {note}"
    unseen = len(table) - len(seen)
    if len(seen) > len(shown):
        note = f"The busiest {len(shown)} of {count(len(seen), f'{base} lane')}. {note}"
    if unseen:
        were = "was" if unseen == 1 else "were"
        note = f"{count(unseen, 'lane')} of the map {were} not {base}. {note}"
    if len(table) > len(shown):
        note = f"{note} All lanes are in lanes.csv."
    rows = text_rows((row for _, row in shown.iterrows()), columns)
    caption = "Lanes, busiest first"
    return Table(name="lanes", caption=caption, columns=columns, rows=rows, note=note)


def _lane_columns(clock: Clock, measure: str) -> list[Column]:
    """Return how a lane is read; the last two are of its busiest interval."""
    words = WORDS[measure]

    def interval(row: pd.Series) -> str:
        if pd.isna(row["busiest_begin"]):
            return NOTHING
        return clock.span(row["busiest_begin"].to_pydatetime(), row["busiest_end"].to_pydatetime())

    def visible(row: pd.Series) -> str:
        return percent(row["base_m"] / row["length_m"], 0)

    def spot(row: pd.Series) -> str:
        place = f"{figure_text(row['busiest_spot_m'])}{THIN}m"
        return f"{percent(row['busiest_spot'], 0, off=row['busiest_spot_se'])} at {place}"

    def share(name: str) -> Callable[[pd.Series], str]:
        return lambda row: percent(row[name], off=row[f"{name}_se"])

    return [
        Column("Lane", "", 0.9, lambda row: str(row["lane"])),
        Column("Leads to", "", 1.5, lambda row: direction(row["east_m"], row["north_m"]), False),
        Column("Length", "m", 1.2, lambda row: figure_text(row["length_m"])),
        Column(words.base.capitalize(), "of length", 1.2, visible),
        Column(words.share, f"of {words.base} time", 1.75, share("share")),
        Column("Busiest spot", f"{measure}, place", 2.35, spot),
        Column(
            "Busy part", f"m with 20 % {measure} or more", 1.5,
            lambda row: figure_text(row["busy_m"], 1),
        ),
        Column("Busiest interval", "", 1.7, interval, False),
        Column(words.share, "in that interval", 1.75, share("busiest_share")),
    ]  # fmt: skip


def _quality_table(quality: Quality | None, clock: Clock, tracks: str) -> Table:
    """Return what sensors delivered by hour, those with a fault first where there are many."""
    columns = _hour_columns(clock)
    note, rows = "What sensors delivered is not known.", []
    if quality is not None:
        table = quality.table
        lines = [f"{sensor}: {text}." for sensor, text in _hours_in_words(table).items()]
        if len(table) > MOST_HOURS:
            faulty = table["verdict"].ne(GOOD).sort_values(ascending=False, kind="stable").index
            table = table.loc[faulty].head(MOST_HOURS)
            lines.append(
                f"Here {MOST_HOURS} of {figure_text(len(quality.table))} rows, those with a fault "
                "first; all are in quality.csv."
            )
        note, rows = " ".join(lines), text_rows((row for _, row in table.iterrows()), columns)
    caption, note = "Measurements by sensor and hour", f"{note} {tracks}".strip()
    return Table(name="quality", caption=caption, columns=columns, rows=rows, note=note)


def _hour_columns(clock: Clock) -> list[Column]:
    """Return how an hour of a sensor is read."""

    def number(name: str, digits: int = 0) -> Callable[[pd.Series], str]:
        return lambda row: figure_text(row[name], digits)

    def age(row: pd.Series) -> str:
        return figure_text(row["pose_age_h"], 1) if row["pose_age_h"] >= 0 else NOTHING

    def begin(row: pd.Series) -> str:
        return clock.stamp(row["begin"].to_pydatetime())

    return [
        Column("Sensor", "", 1.0, lambda row: str(row["sensor"]), False),
        Column("Hour from", "", 2.2, begin, False),
        Column("Frames", "received", 1.4, number("frames")),
        Column("Frames", "expected", 1.4, number("frames_expected")),
        Column("Detections", "a frame", 1.6, number("detections_per_frame", 1)),
        Column("Moving", "of them", 1.2, lambda row: percent(row["moving_share"], 0)),
        Column("Clock", "corrected by s", 1.5, number("clock_offset_s", 3)),
        Column("Pose age", "h", 1.0, age),
        Column("Verdict", "", 2.4, lambda row: str(row["verdict"]), False),
    ]


def _hours_in_words(table: pd.DataFrame) -> dict[str, str]:
    """Return by sensor in how many hours no test found fault, in words."""
    words = {}
    for sensor, rows in table.groupby("sensor"):
        good = int(rows["verdict"].eq(GOOD).sum())
        hours = count(len(rows), "hour")
        words[str(sensor)] = (
            f"good in all of {hours}"
            if good == len(rows)
            else (f"good in {figure_text(good)} of {hours}")
        )
    return words
