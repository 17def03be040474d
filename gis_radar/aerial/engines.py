"""Engines: who gets the points on the roads out of the scans."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import laspy
import numpy as np

from gis_radar.aerial.layer import write_layer
from gis_radar.aerial.pdal import INSTALL_HINT, PdalRunner, find_pdal
from gis_radar.aerial.pipeline import Pipeline, passing_classes
from gis_radar.aerial.scans import (
    LEAST_GROUND_SHARE,
    Days,
    Points,
    Scan,
    days_of,
    ground_share,
    open_scan,
)
from gis_radar.aerial.store import PointStore
from gis_radar.crs import Box, moved_box, same_plane, transformer
from gis_radar.errors import GisRadarError, UsageError
from gis_radar.progress import QUIET, Reporter

NAMES = ("auto", "pdal", "laspy")
STAGE = "reading scans"
# PDAL holds the points of a ground filter in memory: more than these go tile by tile.
MOST_AT_ONCE = 5_000_000


@dataclass(frozen=True, kw_only=True)
class Harvest:
    """What was learnt while the points were read.

    Parameters
    ----------
    classified : tuple of bool
        For each scan, whether its classes tell ground from the rest.
    on_road : int
        Points on the roads, in classified scans without those whose class is no road's.
    flown : (date, date), optional
        Days of the first and the last point on the roads, where their times tell days.
    """

    classified: tuple[bool, ...]
    on_road: int
    flown: Days | None


class Engine(Protocol):
    """Gets the points on the roads out of scans."""

    @property
    def name(self) -> str:
        """What it is, with its version."""
        ...

    def fill(self, store: PointStore, scans: Sequence[Scan], *, reporter: Reporter) -> Harvest:
        """Put those points of scans that lie on the roads into a store."""
        ...


def engine_of(name: str, *, reporter: Reporter = QUIET) -> Engine:
    """Return the engine of a name: `pdal`, `laspy`, or `auto` for the first of them that is there.

    Raises
    ------
    GisRadarError
        If it is to be PDAL and there is none.
    """
    if name not in NAMES:
        raise UsageError(f"engine {name!r} is not known", hint=f"one of {', '.join(NAMES)}")
    if name == "laspy":
        return BuiltIn()
    runner = find_pdal(reporter=reporter)
    if runner is not None:
        return Pdal(runner=runner)
    if name == "pdal":
        raise GisRadarError("PDAL was not found on this machine", hint=INSTALL_HINT)
    return BuiltIn()


@dataclass(frozen=True, kw_only=True)
class BuiltIn:
    """Reads, crops, reprojects and masks with laspy, pyproj and shapely."""

    name: str = f"built-in (laspy {laspy.__version__})"

    def fill(self, store: PointStore, scans: Sequence[Scan], *, reporter: Reporter) -> Harvest:
        """Put those points of scans that lie on the roads into a store."""
        total, done = sum(scan.points for scan in scans), 0
        classified: list[bool] = []
        times: list[float] = []
        on_road = 0
        passing = passing_classes(store.site.roads)
        for number, scan in enumerate(scans):
            ground = 0
            for piece in _pieces(scan, store):
                ground += piece.ground
                times += _keep(store, scan, number, piece)
                done += piece.read
                reporter.progress(STAGE, done, total)
            classified.append(ground >= LEAST_GROUND_SHARE * scan.points)
            store.classified(number, ground=classified[-1])
            counts = store.counts[number]
            on_road += int(counts[passing].sum() if classified[-1] else counts.sum())
        return Harvest(classified=tuple(classified), on_road=on_road, flown=days_of(times))


@dataclass(frozen=True, kw_only=True)
class Pdal:
    """Runs the pipeline with PDAL."""

    runner: PdalRunner

    @property
    def name(self) -> str:
        """What it is, with its version."""
        return self.runner.name

    def fill(self, store: PointStore, scans: Sequence[Scan], *, reporter: Reporter) -> Harvest:
        """Put those points of scans that lie on the roads into a store."""
        classified = tuple(ground_share(scan) >= LEAST_GROUND_SHARE for scan in scans)
        pipeline = Pipeline(scans=tuple(scans), classified=classified, roads=store.site.roads)
        store.classified(0, ground=True)  # whatever the scans were, the pipeline classified them
        times: list[float] = []
        with tempfile.TemporaryDirectory(prefix="gis_radar_") as name:
            layer, points = Path(name) / "roads.gpkg", Path(name) / "points.laz"
            write_layer(store.site.roads, layer)
            parts = _parts(pipeline)
            for done, within in enumerate(parts):
                document = pipeline.document(roads=layer, points=points, within=within)
                self.runner.run(document, reporter=reporter)
                if _holds_points(points):
                    result = open_scan(points, crs=store.site.roads.crs)
                    for piece in _pieces(result, store):
                        times += _keep(store, result, 0, piece)
                points.unlink(missing_ok=True)
                reporter.progress("running the pipeline", done + 1, len(parts))
        return Harvest(classified=classified, on_road=store.total, flown=days_of(times))


def _parts(pipeline: Pipeline) -> list[Box | None]:
    """Return the parts of the site to run one after the other; one None is the whole site."""
    waiting = sum(
        scan.points
        for scan, classified in zip(pipeline.scans, pipeline.classified, strict=True)
        if not classified
    )
    if waiting <= MOST_AT_ONCE or len(pipeline.scans) == 1:
        return [None]
    return [moved_box(scan.bounds, scan.crs, pipeline.roads.crs) for scan in pipeline.scans]


def _holds_points(path: Path) -> bool:
    with laspy.open(path) as reader:
        return bool(reader.header.point_count)


def _pieces(scan: Scan, store: PointStore) -> Iterator[Points]:
    roads = store.site.roads
    return scan.pieces(moved_box(roads.area.bounds, roads.crs, scan.crs))


def _keep(store: PointStore, scan: Scan, number: int, piece: Points) -> list[float]:
    """Store the points on the roads; return their earliest and latest time, if any."""
    x, y = piece.x, piece.y
    if not same_plane(scan.crs, store.site.roads.crs):
        x, y = transformer(scan.crs, store.site.roads.crs).transform(x, y)
    on_road, block = store.site.on_road(x, y)
    xyz = np.column_stack([x[on_road], y[on_road], piece.z[on_road]])
    store.add(xyz, piece.category[on_road], block, number)
    if piece.gps_time is None or len(on_road) == 0:
        return []
    times = piece.gps_time[on_road]
    return [float(times.min()), float(times.max())]
