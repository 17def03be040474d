"""Select the points on the roads out of the scans, by PDAL or by laspy.

The pipeline has only stages that PDAL 2.2 and today's PDAL share. For classified scans all of them
stream, so memory does not grow with the points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import geopandas as gpd
import laspy
import numpy as np
import shapely

from gis_radar.base import (
    QUIET,
    Box,
    GisRadarError,
    Reporter,
    Text,
    UsageError,
    add_layer,
    name_of,
    reprojected_box,
    same_coordinates,
    scratch_folder,
)
from gis_radar.scans.columns import LEAST_GROUND, read_columns
from gis_radar.scans.pdal import INSTALL_HINT, PdalRunner, find_pdal
from gis_radar.scans.point_store import PointStore
from gis_radar.scans.roads import Roads
from gis_radar.scans.scan import (
    NEVER_CLASSES,
    ROAD_CLASSES,
    Days,
    Scan,
    box_with_margin,
    days_flown,
    open_scan,
)
from gis_radar.scans.shift import BESIDE_M

_LAYER, _COLUMN = "roads", "road"
# Margin around a road for PDAL's ground filter: wider than its window (SMRF, 18 m).
_FILTER_MARGIN_M = 30.0
_MARK_DIMENSION = "UserData"


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """Selection of the points on the roads, as stages of PDAL.

    Parameters
    ----------
    scans : tuple of Scan
        Scans that touch the site.
    classified : tuple of bool
        For each scan, whether its classes distinguish ground.
    roads : Roads
        Roads of the site.
    margin_m : float
        Margin around a road for the ground filter, metres.
    """

    scans: tuple[Scan, ...]
    classified: tuple[bool, ...]
    roads: Roads = field(repr=False)
    margin_m: float = _FILTER_MARGIN_M

    def document(self, *, roads: Path, points: Path, within: Box | None = None) -> dict[str, Any]:
        """Return the pipeline as a document for PDAL.

        Parameters
        ----------
        roads : Path
            The GeoPackage with the layer `roads`.
        points : Path
            The LAZ file that the pipeline writes.
        within : Box, optional
            Part of the site, in the roads' system: only scans that touch it are read. The margin
            around it, read for the ground filter, is left out again.
        """
        site = box_with_margin(self.roads.area.bounds, self.margin_m)
        area = site
        if within is not None:
            area = _intersection(site, box_with_margin(within, self.margin_m))
        groups = [self._group(area, classified=is_classified) for is_classified in (True, False)]
        stages = [stage for group in groups for stage in group]
        if all(groups):
            ends = [group[-1]["tag"] for group in groups]
            stages.append({"type": "filters.merge", "inputs": ends})
        if within is not None:
            stages.append({"type": "filters.crop", "bounds": _bounds_text(within)})
        stages += [
            {"type": "filters.assign", "assignment": f"{_MARK_DIMENSION}[:]=0"},
            {
                "type": "filters.overlay", "datasource": str(roads), "layer": _LAYER,
                "column": _COLUMN, "dimension": _MARK_DIMENSION,
            },
            {"type": "filters.range", "limits": f"{_MARK_DIMENSION}[1:1]"},
            {
                "type": "writers.las", "filename": str(points), "minor_version": 4,
                "dataformat_id": 6, "a_srs": name_of(self.roads.crs),
                "scale_x": 0.001, "scale_y": 0.001, "scale_z": 0.001,
                "offset_x": int(site[0]), "offset_y": int(site[1]), "offset_z": 0,
            },
        ]  # fmt: skip
        return {"pipeline": stages}

    def _group(self, area: Box, *, classified: bool) -> list[dict[str, Any]]:
        """Return the stages up to the selection by class, for classified or unclassified scans."""
        kind = "classified" if classified else "unclassified"
        stages, ends = [], []
        for number, (scan, is_classified) in enumerate(
            zip(self.scans, self.classified, strict=True)
        ):
            if is_classified is classified and scan.touches(area, self.roads.crs):
                stages += self._read(number, scan, area)
                ends.append(stages[-1]["tag"])
        if not stages:
            return []
        stages.append({"type": "filters.merge", "inputs": ends, "tag": f"all_{kind}"})
        if not classified:
            stages += [
                {"type": "filters.assign", "assignment": "Classification[:]=1"},
                {"type": "filters.elm"},
                {"type": "filters.smrf", "ignore": "Classification[7:7]"},
            ]
        passing = runs(passing_classes(self.roads))
        limits = ",".join(f"Classification[{first}:{last}]" for first, last in passing)
        return [*stages, {"type": "filters.range", "limits": limits, "tag": kind}]

    def _read(self, number: int, scan: Scan, area: Box) -> list[dict[str, Any]]:
        """Return the stages that read a scan, crop it, and bring it into the map's CRS."""
        box = reprojected_box(area, self.roads.crs, scan.crs)
        # The file's own system may be compound; heights must stay as they are.
        stages: list[dict[str, Any]] = [
            {
                "type": "readers.las", "filename": str(scan.path.resolve()),
                "override_srs": name_of(scan.crs), "tag": f"scan_{number}",
            },
            {"type": "filters.crop", "bounds": _bounds_text(box), "tag": f"crop_{number}"},
        ]  # fmt: skip
        if not same_coordinates(scan.crs, self.roads.crs):
            stages.append({
                "type": "filters.reprojection", "in_srs": name_of(scan.crs),
                "out_srs": name_of(self.roads.crs), "tag": f"map_{number}",
            })  # fmt: skip
        # Without its input by name, a stage of PDAL 2.2 streams the points of a reader twice.
        for stage, before in zip(stages[1:], stages, strict=False):
            stage["inputs"] = [before["tag"]]
        return stages


def passing_classes(roads: Roads) -> list[int]:
    """Return the classes that pass: road for certain; with heights in the map, all that may be.

    A bridge may have any class; the map's heights select its points later.
    """
    if roads.has_heights:
        return [number for number in range(256) if number not in NEVER_CLASSES]
    return list(ROAD_CLASSES)


def _bounds_text(box: Box) -> str:
    west, south, east, north = (repr(round(side, 3)) for side in box)
    return f"([{west},{east}],[{south},{north}])"


def _intersection(a: Box, b: Box) -> Box:
    return max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])


def runs(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Return ascending numbers as runs without gaps: (first, last) of each."""
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]


def write_layer(roads: Roads, path: Path, *, outside: Any = None) -> None:
    """Write the layer `roads`, and the layer `outside` with the part outside the scans.

    Parameters
    ----------
    roads : Roads
        Roads of the site.
    path : Path
        The GeoPackage.
    outside : MultiPolygon, optional
        Part of the roads outside the scans.
    """
    parts = shapely.get_parts(roads.area)
    layers = {_LAYER: gpd.GeoDataFrame({_COLUMN: [1] * len(parts)}, geometry=parts, crs=roads.crs)}
    if outside is not None:
        shapes = shapely.get_parts(outside)
        layers["outside"] = gpd.GeoDataFrame(
            {"area_m2": shapely.area(shapes)}, geometry=shapes, crs=roads.crs
        )
    for name, table in layers.items():
        add_layer(table, path, name, geometry_type="Polygon")


ENGINE_NAMES = ("auto", "pdal", "laspy")
_STAGE = "reading scans"
# PDAL holds the points of a ground filter in memory: more than these are run scan by scan.
MOST_AT_ONCE = 5_000_000


# Result of an engine: how it selected the points on the roads, as stages of PDAL; their number, in
# classified scans only those of classes that pass; first and last day, where GPS times give days.
Selection: TypeAlias = tuple[Pipeline, int, Days | None]
# A function that puts the points of scans on the roads, and those around, into a store.
Engine: TypeAlias = Callable[[PointStore, Sequence[Scan], Reporter], Selection]


def engine_of(name: str, *, reporter: Reporter = QUIET) -> tuple[str, Engine]:
    """Return an engine by a name of `ENGINE_NAMES`, after its title; `auto` prefers PDAL.

    Raises
    ------
    UsageError
        If the name is unknown; GisRadarError if it is `pdal` and there is none.
    """
    if name not in ENGINE_NAMES:
        raise UsageError(
            "engine {} is not known", repr(name), hint=Text("one of {}", ", ".join(ENGINE_NAMES))
        )
    runner = None if name == "laspy" else find_pdal(reporter=reporter)
    if runner is not None:
        return runner.name, partial(_fill_by_pdal, runner)
    if name == "pdal":
        raise GisRadarError("PDAL was not found on this machine", hint=INSTALL_HINT)
    return f"laspy {laspy.__version__}", _fill_by_laspy


def _fill_by_laspy(store: PointStore, scans: Sequence[Scan], reporter: Reporter) -> Selection:
    """Put the points on the roads into a store, read batch by batch by laspy."""
    total, done, on_road = sum(scan.points for scan in scans), 0, 0
    classified: list[bool] = []
    times: list[float] = []
    roads = store.blocks.roads
    passing = passing_classes(roads)
    box = box_with_margin(roads.area.bounds, BESIDE_M)
    for number, scan in enumerate(scans):
        ground = 0
        for batch in scan.batches(box, roads.crs, reporter=reporter):
            store.around.add(np.array([batch.x, batch.y, batch.z]).T, batch.category)
            ground += batch.ground
            times += store.add(batch, number)
            done += batch.read
            reporter.progress(_STAGE, done, total)
        classified.append(ground >= LEAST_GROUND * scan.points)
        store.classified(number, ground=classified[-1])
        counts = store.counts[number]
        on_road += int(counts[passing].sum() if classified[-1] else counts.sum())
    pipeline = Pipeline(scans=tuple(scans), classified=tuple(classified), roads=roads)
    return pipeline, on_road, days_flown(times)


def _fill_by_pdal(
    runner: PdalRunner, store: PointStore, scans: Sequence[Scan], reporter: Reporter
) -> Selection:
    """Put the points on the roads into a store, selected by PDAL's pipeline."""
    roads = store.blocks.roads
    box = box_with_margin(roads.area.bounds, BESIDE_M)
    classified = tuple(
        read_columns([scan], [store.around], box, roads.crs, reporter=reporter) >= LEAST_GROUND
        for scan in scans
    )
    pipeline = Pipeline(scans=tuple(scans), classified=classified, roads=roads)
    store.classified(0, ground=True)  # the pipeline has selected by class
    times: list[float] = []
    with scratch_folder() as folder:
        layer, points = folder / "roads.gpkg", folder / "points.laz"
        write_layer(roads, layer)
        parts = _batches_of_site(pipeline)
        for done, within in enumerate(parts):
            document = pipeline.document(roads=layer, points=points, within=within)
            runner.run(document, reporter=reporter)
            with laspy.open(points) as reader:
                empty = reader.header.point_count == 0
            if not empty:
                result = open_scan(points, crs=roads.crs)
                for batch in result.batches(roads.area.bounds, roads.crs):
                    times += store.add(batch, 0)
            points.unlink()
            reporter.progress("running the pipeline", done + 1, len(parts))
    return pipeline, store.total, days_flown(times)


def _batches_of_site(pipeline: Pipeline) -> list[Box | None]:
    """Return the boxes of the site to run one after the other; a single None is the whole site."""
    scans = zip(pipeline.scans, pipeline.classified, strict=True)
    in_memory = sum(scan.points for scan, classified in scans if not classified)
    if in_memory <= MOST_AT_ONCE or len(pipeline.scans) == 1:
        return [None]
    return [reprojected_box(scan.bounds, scan.crs, pipeline.roads.crs) for scan in pipeline.scans]
