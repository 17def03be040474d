"""From a folder of results to a report of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from gis_radar.errors import OutputError, UsageError
from gis_radar.files import whole_files
from gis_radar.heatmap import HeatMap
from gis_radar.heatmap.heatmap import LANES, LANES_BY_INTERVAL, PAGE, PAPER, QUALITY, SENSORS
from gis_radar.notebooks import card
from gis_radar.progress import QUIET, Reporter
from gis_radar.quality import Quality, measure_quality
from gis_radar.report.content import Content
from gis_radar.report.findings import Findings, content_of, totals_of, write_sensor_table
from gis_radar.report.lanes import lane_table, sum_by_lane, write_lane_intervals, write_lanes
from gis_radar.report.maps import draw_maps, draw_plan, lay_out
from gis_radar.report.pages import page_of, write_pdf
from gis_radar.report.results import Results, read_results
from gis_radar.report.words import Clock, utc, write_csv
from gis_radar.steps import zone_of


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
        By default that of the site, or the name of the folder.
    timezone : str, optional
        Whose clocks the report's times follow, such as Europe/Berlin; by default the site's,
        or UTC.
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
    results = read_results(folder, [Path(each) for each in occupancies])
    heat = results.heat
    zone = timezone or str(results.site.get("time_zone") or "UTC")
    clock, sums, picture = _clock(heat, zone), sum_by_lane(heat), lay_out(heat)
    table = lane_table(heat, sums)
    found = Findings(
        results=results,
        title=title or str(results.site.get("title") or "") or folder.resolve().name,
        clock=clock,
        quality=_quality(results, zone, reporter),
        lanes=sums,
        table=table,
    )
    maps = draw_maps(heat, picture, sums, results.poses, results.credits, clock, reporter)
    content = content_of(found, maps, draw_plan(heat.tiles, picture, sums.lanes, table))
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
    """Return the writer of each file."""
    clock, heat, quality = found.clock, found.results.heat, found.quality
    writers: dict[str, Callable[[Path], None]] = {
        PAGE: lambda path: _write_text(path, page_of(content)),
        PAPER: lambda path: write_pdf(content, path),
        LANES: lambda path: write_lanes(path, found.table, clock),
        LANES_BY_INTERVAL: lambda path: write_lane_intervals(path, heat, found.lanes, clock),
        SENSORS: lambda path: write_sensor_table(path, found.results),
    }
    if quality is not None:
        writers[QUALITY] = lambda path: _write_quality(path, quality)
    return writers


def _write_quality(path: Path, quality: Quality) -> None:
    """Write the table of :func:`gis_radar.measure_quality`, a row a sensor and hour."""
    rows = (
        tuple(utc(cell) if isinstance(cell, pd.Timestamp) else cell for cell in row)
        for row in quality.table.itertuples(index=False, name=None)
    )
    write_csv(path, list(quality.table.columns), rows)


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
    """Return the figures as numbers, None where not known; the page has them in words."""
    begin, end = found.results.heat.whole.span()
    return {
        "title": content.title,
        "begin": utc(begin),
        "end": utc(end),
        "timezone": str(found.clock.zone),
        "pictures": len(content.map.frames) + 1,
        "sensors": found.results.sensors,
        **totals_of(found),
        "remarks": list(content.remarks),
    }
