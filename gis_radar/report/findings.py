"""What was found in a folder of results, and how a report says it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from gis_radar.quality import Quality
from gis_radar.report import basis, tables
from gis_radar.report.canvas import png
from gis_radar.report.content import Content, Figure, MapPart
from gis_radar.report.folder import Results
from gis_radar.report.lanes import LaneTally
from gis_radar.report.overlay import thumbnail
from gis_radar.report.words import THIN, Clock, number

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
        facts=_facts(results, found.table),
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


def _facts(results: Results, table: pd.DataFrame) -> list[tuple[str, str]]:
    """Return the figures at the top."""
    seconds = results.traffic.overall
    seen = seconds.observed > 0
    length = results.traffic.tiles["length_m"].to_numpy(np.float64)
    hit = int(np.count_nonzero(seconds.occupied[seen]))
    top = tables.busiest_of(table)
    sensors = results.sensors
    return [
        ("Sensors", str(len(sensors)) if sensors else "not known here"),
        ("Lanes observed", f"{int(table['occupancy'].notna().sum())} of {len(table)}"),
        (
            "Lane length observed",
            f"{number(float(length[seen].sum()))} of {number(length.sum())}{THIN}m",
        ),
        ("Tiles hit", f"{number(hit)} of {number(int(seen.sum()))}"),
        ("Busiest lane", f"No. {top[0]}: {top[1]}" if top else "none was hit"),
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
