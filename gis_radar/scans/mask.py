"""The road mask: from airborne scans to the road's height in cells of half a metre."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from gis_radar.base import (
    CELL_M,
    QUIET,
    Floats,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    UsageError,
    atomic_writes,
    card,
    name_of,
    paths_of,
    reprojected_box,
    scratch_folder,
)
from gis_radar.hdmap import LaneletMap
from gis_radar.scans.cells import SQUARE_M, RoadCells, make_cells
from gis_radar.scans.engines import Pipeline, engine_of, write_layer
from gis_radar.scans.point_store import PointStore, cut_into_blocks
from gis_radar.scans.roads import Roads, read_roads, roads_of_map
from gis_radar.scans.scan import Days, Scan, open_scan, warn_inexact, write_road
from gis_radar.scans.settings import DEFAULTS, MaskSettings
from gis_radar.scans.shift import warn_roads_shifted

_SIDE_FILE_ENDINGS = (".roads.gpkg", ".pipeline.json")
_BARE_M2 = 20.0  # a square without a point and with so much road is outside the scans
_WARN_OUTSIDE = 0.001  # share of roads outside the scans from which on a warning is logged
_WARN_OFFSET_M = 2.0  # the same for the scan's height over the map: it may be of another level
_DATUM_M = 110.0  # no vertical datums differ by more: geoid undulations are under 107 m (EGM2008)
# Share of the road's cells inside the scans' extents below which there is no mask, and below which
# a warning is logged. A scan of 1 point/m2 fills 0.2 of the cells of 0.5 m.
_LEAST_COVERED, _WARN_COVERED = 0.02, 0.1
# The same share over that of a bare road at the density of the points, below which a warning is
# logged: 0.79 to 0.99 in scans of the place, 0.46 to 0.57 in those of a neighbouring town.
_WARN_BARE = 0.65


@dataclass(frozen=True, kw_only=True)
class RoadMask:
    """The road as the scans show it.

    Parameters
    ----------
    points : (n, 3) array
        Centres of cells of 0.5 m with the road's height, metres.
    roads : Roads
        Roads of the map, in the coordinate system of the points.
    outside : MultiPolygon
        The part of the map's roads outside the scans.
    engine : str
        Program that read the scans, with its version.
    pipeline : Pipeline
        How the points were selected, as stages of PDAL.
    vertical : tuple of str
        Names of the vertical systems that the scans state.
    flown : (date, date), optional
        First and last day of the scans on the roads: the epoch of what they show.
    points_in, points_on_road : int
        Number of points in the scans that touch the site, and of those on its roads; in classified
        scans only those of classes that pass.
    cells : RoadCells
        The cells, with figures about their making.
    settings : MaskSettings
        Settings in effect.
    """

    points: Floats = field(repr=False)
    roads: Roads
    outside: Any = field(repr=False)
    engine: str
    pipeline: Pipeline = field(repr=False)
    vertical: tuple[str, ...]
    flown: Days | None
    points_in: int
    points_on_road: int
    cells: RoadCells = field(repr=False)
    settings: MaskSettings = field(default=DEFAULTS, repr=False)

    @property
    def covered(self) -> float:
        """Share of the road's cells that have a point."""
        return len(self.points) / self.cells.area_cells

    @property
    def density(self) -> float:
        """Points a square metre of the road that was scanned."""
        scanned = self.roads.area.area - self.outside.area
        return self.points_on_road / scanned if scanned > 0.0 else 0.0

    def figures(self) -> dict[str, Any]:
        """Return the figures of the result, ready for JSON."""
        offset = self.cells.offset_m
        return {
            "engine": self.engine,
            "crs": name_of(self.roads.crs),
            "vertical_crs": ", ".join(self.vertical) or None,
            "epoch": [day.isoformat() for day in self.flown] if self.flown else None,
            "scans": len(self.pipeline.scans),
            "classified": [bool(status) for status in self.pipeline.classified],
            "points_in": self.points_in,
            "points_on_road": self.points_on_road,
            "points_used": self.cells.used,
            "density_per_m2": round(self.density, 3),
            "cells": len(self.points),
            "covered": round(self.covered, 4),
            "small_clusters_removed": self.cells.removed,
            "road_m2": round(self.roads.area.area, 1),
            "outside_m2": round(self.outside.area, 1),
            "outside_share": round(self.outside.area / self.roads.area.area, 4),
            "levels": len(self.roads.levels),
            "scan_over_map_m": None if np.isnan(offset) else offset,
            "settings": asdict(self.settings),
        }

    def write(self, path: str | Path) -> list[Path]:
        """Write the points of the road, the pipeline, and the map's roads as a layer.

        Parameters
        ----------
        path : str or Path
            The LAZ (or LAS) file; `<stem>.pipeline.json` and `<stem>.roads.gpkg` go beside it. The
            pipeline names files relative to that folder where it can: run PDAL there.

        Returns
        -------
        list of Path
            What was written.
        """
        path = Path(path)
        require_road_name(path)
        layer, document = (path.with_name(path.stem + end) for end in _SIDE_FILE_ENDINGS)
        outputs = [path, document, layer]
        stages = self.pipeline.document(
            roads=layer.resolve(), points=path.resolve().with_name(f"{path.stem}.points.laz")
        )
        for stage in stages["pipeline"]:
            names = {key: stage[key] for key in ("filename", "datasource") if key in stage}
            stage |= {
                key: relative_name(name, path.resolve().parent) for key, name in names.items()
            }
        with atomic_writes(path) as (private, places):
            parts = {output: private / output.name for output in outputs}
            write_layer(self.roads, parts[layer], outside=self.outside)
            text = json.dumps(stages, indent=2) + "\n"
            parts[document].write_text(text, encoding="utf-8")
            write_road(self.points, parts[path], crs=self.roads.crs, settings=self.settings)
            places.update({part: output for output, part in parts.items()})
        return outputs

    def __repr__(self) -> str:
        return (
            f"RoadMask({len(self.points)} cells of {CELL_M} m, {self.covered:.0%} of the roads, "
            f"{self.density:.1f} points/m2, {self.engine})"
        )

    def _repr_html_(self) -> str:
        figures = self.figures()
        del figures["settings"]
        return card("Road mask", figures)


def relative_name(name: str, folder: Path) -> str:
    """Return a name relative to a folder; unchanged where they share at most the root.

    Parameters
    ----------
    name : str
        An absolute path.
    folder : Path
        An absolute path, too.

    Returns
    -------
    str
        A relative name has forward slashes.
    """
    try:
        shared = os.path.commonpath([name, folder])
    except ValueError:  # drives of Windows
        return name
    return name if shared == folder.anchor else Path(os.path.relpath(name, folder)).as_posix()


def require_road_name(path: str | Path) -> None:
    """Refuse a name that does not end in .laz or .las; called before the work begins."""
    if Path(path).suffix.lower() not in {".laz", ".las"}:
        raise UsageError("{}: a road is written as LAZ", path, hint="end the name in .laz")


def mask_road(
    scans: str | Path | Sequence[str | Path],
    roads: Roads | LaneletMap | str | Path,
    *,
    engine: str = "auto",
    scan_crs: Any = None,
    settings: MaskSettings = DEFAULTS,
    reporter: Reporter = QUIET,
) -> RoadMask:
    """Mask the road out of airborne scans (the paper, "Method Overview").

    Parameters
    ----------
    scans : path or sequence of paths
        LAS, LAZ or COPC files; those that do not touch the site are skipped by their extent.
    roads : LaneletMap, Roads, str or Path
        A map, of which the lanelets for vehicles count, or polygons of roads, or a file of either.
        :func:`gis_radar.scans.read_roads` reads files that do not say in what coordinate system
        they are, or have several layers.
    engine : str
        `pdal`, `laspy` (built-in), or `auto` for PDAL where there is one.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    settings : MaskSettings
        Settings of the algorithm.
    reporter : Reporter
        Receives progress and remarks.

    Raises
    ------
    InputError
        If a scan is damaged, or map and scans do not overlap; CrsError if a scan has no
        coordinate system; NoAnswerError if nothing on the roads is a road's surface.
    """
    if isinstance(roads, str | Path):
        roads = read_roads(roads, reporter=reporter)
    elif isinstance(roads, LaneletMap):
        roads = roads_of_map(roads)
    name, fill = engine_of(engine, reporter=reporter)
    opened = [open_scan(scan, crs=scan_crs) for scan in paths_of(scans)]
    touching = [scan for scan in opened if scan.touches(roads.area.bounds, roads.crs)]
    if not touching:
        raise _no_overlap(opened, roads)
    warn_inexact(touching, roads.crs, reporter)
    blocks = cut_into_blocks(roads)
    with scratch_folder() as folder:
        store = PointStore(blocks, folder)
        pipeline, on_road, flown = fill(store, touching, reporter)
        if store.total == 0:
            raise _no_overlap(touching, roads)
        cells = make_cells(store, settings=settings, reporter=reporter)
    if len(cells.points) == 0:
        raise NoAnswerError(
            "{}: {} points on its roads, but none on a road's surface", roads.source, store.total
        )
    mask = RoadMask(
        points=cells.points, roads=roads, engine=name,
        outside=_outside(cells, touching, roads),
        vertical=tuple(sorted({scan.vertical for scan in touching} - {""})), flown=flown,
        pipeline=pipeline,
        points_in=sum(scan.points for scan in touching), points_on_road=on_road,
        cells=cells, settings=settings,
    )  # fmt: skip
    _report(mask, opened, reporter)
    warn_roads_shifted(store.around, roads.area, touching[0].path, reporter)
    return mask


def _no_overlap(scans: Sequence[Scan], roads: Roads) -> InputError:
    """Return the error for scans without a point on the roads."""
    names = ", ".join(str(scan.path) for scan in scans[:3]) + (" ..." if len(scans) > 3 else "")
    west, south, east, north = roads.area.bounds
    return InputError(
        "{}: no point lies on the roads of {}: scan and map do not overlap",
        names,
        roads.source,
        hint=Text(
            "the roads lie at {:.0f} {:.0f} in {}; is the coordinate system right?",
            (west + east) / 2,
            (south + north) / 2,
            roads.crs.name,
        ),
    )


def _outside(cells: RoadCells, scans: Sequence[Scan], roads: Roads) -> shapely.MultiPolygon:
    """Return the roads outside the scans' extents, or in squares without a single point."""
    extents = [reprojected_box(scan.bounds, scan.crs, roads.crs) for scan in scans]
    known = np.isfinite(extents).all()
    boxes = [shapely.box(*extent) for extent in extents] if known else [roads.area]
    beyond = shapely.difference(roads.area, shapely.union_all(boxes))
    without_point, which = np.unique(cells.missing[:, :2] // SQUARE_M, axis=0, return_inverse=True)
    count = np.bincount(which.ravel(), cells.missing[:, 2], len(without_point))
    without_point = without_point[count * CELL_M**2 >= _BARE_M2]
    seen = set(map(tuple, (cells.seen // SQUARE_M).tolist()))
    unseen = np.array([place for place in without_point.tolist() if tuple(place) not in seen])
    empty = shapely.intersection(shapely.union_all(_strips(unseen, SQUARE_M)), roads.area)
    parts = shapely.get_parts(shapely.union(beyond, empty))
    return shapely.MultiPolygon(list(parts[shapely.area(parts) > 0.0]))


def _strips(squares: Floats, side_m: float) -> Any:
    """Return squares (column, row; ascending) as boxes: adjacent ones of a column make one."""
    if len(squares) == 0:
        return np.empty(0, object)
    across, up = squares.T
    new = np.ones(len(squares), bool)
    new[1:] = (np.diff(across) != 0) | (np.diff(up) != 1)
    first = np.flatnonzero(new)
    last = np.append(first[1:], len(squares)) - 1
    west, south, north = across[first], up[first], up[last] + 1
    return shapely.box(west * side_m, south * side_m, (west + 1) * side_m, north * side_m)


def _inside_share(mask: RoadMask, scans: Sequence[Scan]) -> float:
    """Return the share of the road's cells inside the scans' extents that have a point."""
    extents = [reprojected_box(scan.bounds, scan.crs, mask.roads.crs) for scan in scans]
    if not np.isfinite(extents).all():
        return mask.covered
    within = shapely.union_all([shapely.box(*extent) for extent in extents])
    share = shapely.intersection(mask.roads.area, within).area / mask.roads.area.area
    return mask.covered / share if share > 0.0 else 0.0


def _bare_share(mask: RoadMask) -> float:
    """Return the share of a bare road's cells that strewn points would fill (Poisson).

    Of `share` cells with a point, each holds `points / share` on average.
    """
    share, points = 1.0, mask.cells.used / max(len(mask.points), 1)
    for _ in range(100):
        share = 1.0 - math.exp(-points * share)
    return share


def _report(mask: RoadMask, opened: Sequence[Scan], reporter: Reporter) -> None:
    """Refuse an empty mask; log engine and skipped scans; warn of roads outside and few points."""
    covered = _inside_share(mask, mask.pipeline.scans)
    if covered < _LEAST_COVERED:
        raise NoAnswerError(
            "{}: only {:.1%} of the road inside the scans has points",
            mask.pipeline.scans[0].path, covered,
            hint="is the scan damaged, very sparse, or of another place?",
        )  # fmt: skip
    reporter.log(Text("scans read by {}", mask.engine))
    skipped = len(opened) - len(mask.pipeline.scans)
    if skipped:
        reporter.log(
            Text("{} of {} scans do not touch the site and were skipped", skipped, len(opened))
        )
    share = mask.outside.area / mask.roads.area.area
    if share > _WARN_OUTSIDE:
        reporter.warn(
            "{:.1%} of the map's roads lie outside the scans: {:.0f} m2 within {:.0f} "
            "{:.0f} {:.0f} {:.0f} (layer outside)",
            share, mask.outside.area, *mask.outside.bounds,
        )  # fmt: skip
    if covered < _WARN_COVERED:
        reporter.warn("only {:.0%} of the road inside the scans has points", covered)
    elif covered < _WARN_BARE * (bare := _bare_share(mask)):
        reporter.warn(
            "only {:.0%} of the road inside the scans is road in them, where so many points fill "
            "{:.0%}: are they of another place, or older than the map?",
            covered,
            bare,
        )
    offset = mask.cells.offset_m
    if abs(offset) > _WARN_OFFSET_M:
        text = Text(
            "the scans lie {:.2f} m over the map's heights: another vertical datum?", offset
        )
        if abs(offset) > _DATUM_M:
            text = Text("{} none is so far off: are they in feet, or of another place?", text)
        reporter.warn(text)
