"""What was found in a folder of results, and how a report says it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from gis_radar.quality import Quality
from gis_radar.report import folder as basis
from gis_radar.report import tables
from gis_radar.report.canvas import png
from gis_radar.report.content import Content, Figure, MapPart
from gis_radar.report.folder import Results
from gis_radar.report.lanes import LaneTally
from gis_radar.report.overlay import thumbnail
from gis_radar.report.words import THIN, Clock, number, percent

FIGURE_PIXELS, FINE_FIGURES = 1600, 6  # more than that many are drawn coarser
COARSE_PIXELS, MOST_FIGURES = 1000, 20


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """What page, paper and tables are made of.

    Parameters
    ----------
    results : Results
        What the folder holds.
    title : str
        Of the report.
    clock : Clock
        Writes its times.
    quality : Quality or None
        What sensors delivered; None where that is not known.
    lanes : LaneTally
        What was counted of each lane, by interval.
    table : DataFrame
        The lanes over the whole time, from :func:`gis_radar.report.lanes.lane_table`.
    """

    results: Results
    title: str
    clock: Clock
    quality: Quality | None
    lanes: LaneTally
    table: pd.DataFrame


class Figures(NamedTuple):
    """Figures of the whole time; the busiest lane is None where none was hit."""

    lanes: int
    lanes_observed: int
    length_m: float
    length_observed_m: float
    tiles_observed: int
    tiles_hit: int
    busiest_lane: int | None
    busiest_occupancy: float | None


def content_of(found: Findings, parts: MapPart, plan: Figure) -> Content:
    """Say what was found.

    Parameters
    ----------
    found : Findings
        What.
    parts : MapPart
        The map.
    plan : Figure
        Where the lanes are.
    """
    results, clock = found.results, found.clock
    traffic = results.traffic
    begin, end = traffic.intervals[0]
    figures = _figures(results)
    return Content(
        title=found.title,
        subtitle=clock.whole(*traffic.whole),
        zone=clock.name,
        until=traffic.whole[1],
        facts=_facts(found),
        remarks=_remarks(results, found.quality),
        map=parts,
        lane_figure=plan,
        lanes=tables.lanes_as_read(found.table, clock, intervals=bool(parts.frames)),
        sensors=tables.sensors_as_read(results, figures=len(figures)),
        sensor_figures=figures,
        quality=tables.quality_as_read(found.quality, clock),
        settings=basis.settings_of(results, (end - begin).total_seconds()),
        sources=basis.sources_of(results),
        definitions=basis.DEFINITIONS,
        made_by=basis.made_by(),
    )


def figures_of(found: Findings) -> Figures:
    """Count what is worth a look."""
    traffic, table = found.results.traffic, found.table
    seconds = traffic.overall
    seen = seconds.observed > 0
    length_m = traffic.tiles["length_m"].to_numpy(np.float64)
    hit = not table.empty and table["occupancy"].iloc[0] > 0  # the busiest stands first
    return Figures(
        lanes=len(table),
        lanes_observed=int(table["occupancy"].notna().sum()),
        length_m=float(length_m.sum()),
        length_observed_m=float(length_m[seen].sum()),
        tiles_observed=int(seen.sum()),
        tiles_hit=int(np.count_nonzero(seconds.occupied[seen])),
        busiest_lane=int(table["lane"].iloc[0]) if hit else None,
        busiest_occupancy=float(table["occupancy"].iloc[0]) if hit else None,
    )


def _facts(found: Findings) -> list[tuple[str, str]]:
    """Return the figures at the top."""
    told, sensors = figures_of(found), found.results.sensors
    busiest = "none was hit"
    if told.busiest_occupancy is not None:
        busiest = f"No. {told.busiest_lane}: {percent(told.busiest_occupancy)}"
    return [
        ("Sensors", str(len(sensors)) if sensors else "not known here"),
        ("Lanes observed", f"{told.lanes_observed} of {told.lanes}"),
        (
            "Lane length observed",
            f"{number(told.length_observed_m)} of {number(told.length_m)}{THIN}m",
        ),
        ("Tiles hit", f"{number(told.tiles_hit)} of {number(told.tiles_observed)}"),
        ("Busiest lane", busiest),
    ]


def _remarks(results: Results, quality: Quality | None) -> list[str]:
    """Return what to know before reading on."""
    lost = tables.lost_of(results)
    remarks = [f"No result for sensor {name}: {why}" for name, why in lost.items()]
    if quality is not None:
        remarks += [f"Sensor {line}" for line in quality.warnings()]
    remarks += tables.warnings_of(results)
    return [*remarks, *results.missing]


def _figures(results: Results) -> list[Figure]:
    """Return the pictures of how poses were found, of the sensors that are shown."""
    found: list[Figure] = []
    poses = [pose for pose in results.poses if pose.sensor in results.figures]
    width = FIGURE_PIXELS if len(poses) <= FINE_FIGURES else COARSE_PIXELS
    for pose in poses[:MOST_FIGURES]:
        image = thumbnail(results.figures[pose.sensor], width)
        if image is None:
            continue
        found.append(
            Figure(
                png=png(image),
                width=image.width,
                height=image.height,
                caption=f"Sensor {pose.sensor}: {tables.how_found(pose)}.",
                alt=(
                    f"How the pose of {pose.sensor} was found: traces of vehicles on the map's "
                    f"lanes; {tables.how_found(pose)}."
                ),
            )
        )
    return found
