"""From a folder of results to a report of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gis_radar.errors import OutputError, UsageError
from gis_radar.files import whole_files
from gis_radar.heatmap.heatmap import LANES, LANES_BY_INTERVAL, PAGE, PAPER, QUALITY, SENSORS
from gis_radar.notebooks import card
from gis_radar.progress import QUIET, Reporter
from gis_radar.quality import Quality, measure_quality
from gis_radar.report.content import Content
from gis_radar.report.findings import Findings, content_of, figures_of
from gis_radar.report.folder import Results, credits_of, read_results
from gis_radar.report.lanes import Traffic, lane_table, lane_tally
from gis_radar.report.map_part import canvas_for, frames_of, lane_figure, map_part
from gis_radar.report.page import page_of
from gis_radar.report.paper import write_pdf
from gis_radar.report.spreadsheets import (
    utc,
    write_lane_intervals,
    write_lanes,
    write_quality,
    write_sensors_table,
)
from gis_radar.report.words import Clock
from gis_radar.steps import zone_of


@dataclass(frozen=True, kw_only=True)
class Report:
    """What a report was made of, and where it is.

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
    What the folder does not tell is said to be unknown. The same results give the same files.

    Parameters
    ----------
    folder : str or Path
        Results of `gis-radar run` or `gis-radar demo`, or the folder of a heat map.
    output : str or Path, optional
        Folder that the report goes to; by default `folder`.
    title : str, optional
        By default that of the site, or the name of the folder.
    timezone : str, optional
        Whose clocks the report's times follow, such as Europe/Berlin; by default the site's,
        or UTC.
    occupancies : sequence of str or Path
        Folders that the heat map was made of, where they are not in `folder`.
    reporter : Reporter
        Hears how far the work is.

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
        raise UsageError("the title is empty", hint="leave it out, or say what the site is called")
    results = read_results(folder, [Path(each) for each in occupancies])
    traffic = results.traffic
    zone = timezone or str(results.site.get("time_zone") or "UTC")
    clock, lanes, canvas = _clock(traffic, zone), lane_tally(traffic.tiles), canvas_for(traffic)
    # Intervals are read once: what is drawn is counted by lane on the way.
    frames = frames_of(traffic, canvas, lanes, clock, reporter)
    found = Findings(
        results=results,
        title=title or str(results.site.get("title") or "") or folder.resolve().name,
        clock=clock,
        quality=_quality(results, zone, reporter),
        lanes=lanes,
        table=lane_table(traffic, lanes),
    )
    parts = map_part(traffic, canvas, frames, lanes, results.poses, credits_of(results))
    content = content_of(found, parts, lane_figure(traffic, canvas, lanes, found.table))
    outputs = _write(folder if output is None else Path(output), found, content, reporter)
    return Report(outputs=outputs, summary=_summary(found, content))


def _clock(traffic: Traffic, timezone: str) -> Clock:
    """Return who writes the times: to the second where an interval does not begin at a minute."""
    edges = [each for span in traffic.intervals for each in span]
    fine = any(each.second or each.microsecond for each in edges)
    first, last = min(edges[0], traffic.whole[0]), max(edges[-1], traffic.whole[1])
    return Clock(zone=zone_of(timezone), first=first, last=last, to_seconds=fine)


def _quality(results: Results, timezone: str, reporter: Reporter) -> Quality | None:
    occupancy = results.occupancy
    if occupancy is None or not any(True for _ in occupancy.frame_log(occupancy.sensors)):
        return None
    return measure_quality(occupancy, timezone=timezone, reporter=reporter)


def _write(place: Path, found: Findings, content: Content, reporter: Reporter) -> list[Path]:
    """Write all files, which appear together or not at all."""
    _make(place)
    writers = _writers(found, content)
    with whole_files(place / PAGE) as (private, places):
        for done, (name, write) in enumerate(writers.items(), start=1):
            write(private / name)
            places[private / name] = place / name
            reporter.progress("writing the report", done, len(writers))
    return [place / name for name in writers]


def _writers(found: Findings, content: Content) -> dict[str, Callable[[Path], None]]:
    """Return who writes each file."""
    clock, spans, quality = found.clock, found.results.traffic.intervals, found.quality
    writers: dict[str, Callable[[Path], None]] = {
        PAGE: lambda path: _write_text(path, page_of(content)),
        PAPER: lambda path: write_pdf(content, path),
        LANES: lambda path: write_lanes(path, found.table, clock),
        LANES_BY_INTERVAL: lambda path: write_lane_intervals(path, found.lanes, spans, clock),
        SENSORS: lambda path: write_sensors_table(path, found.results),
    }
    if quality is not None:
        writers[QUALITY] = lambda path: write_quality(path, quality)
    return writers


def _make(place: Path) -> None:
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(
            f"{place}: cannot be written: {reason}", hint="name a folder for the report"
        ) from error


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


def _summary(found: Findings, content: Content) -> dict[str, Any]:
    """Return the figures as numbers, None where not known; the page says them in words."""
    told = figures_of(found)
    begin, end = found.results.traffic.whole
    busiest = told.busiest_occupancy
    return {
        "title": content.title,
        "begin": utc(begin),
        "end": utc(end),
        "timezone": str(found.clock.zone),
        "pictures": len(content.map.frames) + 1,
        "sensors": found.results.sensors,
        "lanes": told.lanes,
        "lanes_observed": told.lanes_observed,
        "lane_length_observed_m": round(told.length_observed_m, 2),
        "tiles_observed": told.tiles_observed,
        "tiles_hit": told.tiles_hit,
        "busiest_lane": told.busiest_lane,
        "busiest_lane_occupancy": None if busiest is None else round(busiest, 6),
        "remarks": list(content.remarks),
    }
