"""The PDAL pipeline: how points on the roads are got from scans, as a document.

It keeps to stages that PDAL 2.2 and today's PDAL both have. With classified scans all of its
stages stream, so its memory does not grow with the points.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gis_radar.aerial.roads import Roads
from gis_radar.aerial.scans import NEVER_CLASSES, ROAD_CLASSES, Scan
from gis_radar.crs import Box, moved_box, name_of, same_plane

LAYER, COLUMN = "roads", "road"
MARGIN_M = 30.0  # what a ground filter looks at around a road: wider than its window
MARK = "UserData"
Stage = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """Scans to points on the roads.

    Parameters
    ----------
    scans : tuple of Scan
        Those that touch the site.
    classified : tuple of bool
        For each, whether its classes tell ground from the rest.
    roads : Roads
        The site.
    """

    scans: tuple[Scan, ...]
    classified: tuple[bool, ...]
    roads: Roads = field(repr=False)

    def document(self, *, roads: Path, points: Path, within: Box | None = None) -> dict[str, Any]:
        """Return the pipeline as PDAL reads it.

        Parameters
        ----------
        roads : Path
            The GeoPackage with the layer `roads`.
        points : Path
            The LAZ file that the pipeline writes.
        within : Box, optional
            A part of the site, in the roads' system, without those scans that do not touch it;
            around it a margin is read for the ground filter and left out again.
        """
        site = _widened(self.roads.area.bounds, MARGIN_M)
        area = site if within is None else _common(site, _widened(within, MARGIN_M))
        groups = [self._group(area, classified=status) for status in (True, False)]
        stages = [stage for group in groups for stage in group]
        if all(groups):
            ends = [group[-1]["tag"] for group in groups]
            stages.append({"type": "filters.merge", "inputs": ends})
        if within is not None:
            stages.append({"type": "filters.crop", "bounds": _text(within)})
        stages += [
            {"type": "filters.assign", "assignment": f"{MARK}[:]=0"},
            {
                "type": "filters.overlay", "datasource": str(roads), "layer": LAYER,
                "column": COLUMN, "dimension": MARK,
            },
            {"type": "filters.range", "limits": f"{MARK}[1:1]"},
            {
                "type": "writers.las", "filename": str(points), "minor_version": 4,
                "dataformat_id": 6, "a_srs": name_of(self.roads.crs),
                "scale_x": 0.001, "scale_y": 0.001, "scale_z": 0.001,
                "offset_x": int(site[0]), "offset_y": int(site[1]), "offset_z": 0,
            },
        ]  # fmt: skip
        return {"pipeline": stages}

    def _group(self, area: Box, *, classified: bool) -> list[Stage]:
        """Return the stages up to the choice of ground, for scans of one kind."""
        kind = "classified" if classified else "unclassified"
        stages, ends = [], []
        for number, (scan, status) in enumerate(zip(self.scans, self.classified, strict=True)):
            if status is classified and touches(scan, area, self.roads):
                stages += self._read(number, scan, area)
                ends.append(stages[-1]["tag"])
        if not stages:
            return []
        stages.append({"type": "filters.merge", "inputs": ends, "tag": f"all_{kind}"})
        stages += self._ground(classified=classified)
        stages[-1]["tag"] = kind
        return stages

    def _read(self, number: int, scan: Scan, area: Box) -> list[Stage]:
        box = moved_box(area, self.roads.crs, scan.crs)
        # The file's own system may be compound; heights shall stay as they are.
        stages: list[Stage] = [
            {
                "type": "readers.las", "filename": str(scan.path.resolve()),
                "override_srs": name_of(scan.crs), "tag": f"scan_{number}",
            },
            {"type": "filters.crop", "bounds": _text(box), "tag": f"crop_{number}"},
        ]  # fmt: skip
        if not same_plane(scan.crs, self.roads.crs):
            stages.append({
                "type": "filters.reprojection", "in_srs": name_of(scan.crs),
                "out_srs": name_of(self.roads.crs), "tag": f"map_{number}",
            })  # fmt: skip
        # Without its input in words, a stage of PDAL 2.2 streams the points of a reader twice.
        for stage, before in zip(stages[1:], stages, strict=False):
            stage["inputs"] = [before["tag"]]
        return stages

    def _ground(self, *, classified: bool) -> list[Stage]:
        if classified:
            return [{"type": "filters.range", "limits": self._limits()}]
        return [
            {"type": "filters.assign", "assignment": "Classification[:]=1"},
            {"type": "filters.elm"},
            {"type": "filters.smrf", "ignore": "Classification[7:7]"},
            {"type": "filters.range", "limits": self._limits()},
        ]

    def _limits(self) -> str:
        classes = passing_classes(self.roads)
        return ",".join(f"Classification[{a}:{b}]" for a, b in runs(classes))


def passing_classes(roads: Roads) -> list[int]:
    """Return the classes that pass: ground, and where the map knows heights, what may be it.

    A bridge may bear any class; the map's heights find it later.
    """
    if roads.has_heights:
        return [number for number in range(256) if number not in NEVER_CLASSES]
    return list(ROAD_CLASSES)


def touches(scan: Scan, box: Box, roads: Roads) -> bool:
    """Tell whether a scan may have points in a box of the roads' system."""
    west, south, east, north = moved_box(scan.bounds, scan.crs, roads.crs)
    return west <= box[2] and east >= box[0] and south <= box[3] and north >= box[1]


def as_text(document: dict[str, Any]) -> str:
    """Return a document as JSON to read and to run."""
    return json.dumps(document, indent=2) + "\n"


def _text(box: Box) -> str:
    west, south, east, north = (repr(round(side, 3)) for side in box)
    return f"([{west},{east}],[{south},{north}])"


def _widened(box: Box, margin_m: float) -> Box:
    west, south, east, north = box
    return west - margin_m, south - margin_m, east + margin_m, north + margin_m


def _common(a: Box, b: Box) -> Box:
    return max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])


def runs(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Return ascending numbers as runs without gaps."""
    runs: list[tuple[int, int]] = []
    for number in numbers:
        if runs and runs[-1][1] == number - 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    return runs
