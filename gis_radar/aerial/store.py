"""Points on the road by block: in memory while they are few, beyond that in a folder."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.aerial.scans import is_road_class, never_road
from gis_radar.aerial.site import BLOCK_M, Site
from gis_radar.arrays import Booleans, Floats, Integers

MOST_KEPT = 1_000_000
_MM = 1000.0
# Equal points are found by sorting one number each: 20 bits north, 20 east, 22 up, 1 for ground.
_SHIFT, _MOST_TALL = 100_000, 2**22 - 1
# Millimetres from the block's corner: a third of a float64, and equal points are equal.
RECORD = np.dtype(
    [("x", np.int32), ("y", np.int32), ("z", np.int32), ("category", np.uint8), ("scan", np.uint16)]
)


class PointStore:
    """Points on the roads of a site.

    What comes out depends on the points alone, not on the order or the pieces in which they came.
    `counts` has for each scan the number of points of each class.

    Parameters
    ----------
    site : Site
        The blocks.
    folder : Path
        Where points go when they become many; must exist.
    """

    def __init__(self, site: Site, folder: Path) -> None:
        self.site = site
        self.counts: dict[int, Integers] = defaultdict(lambda: np.zeros(256, np.int64))
        self._folder = folder
        self._kept: dict[int, list[Any]] = {}
        self._in_memory = 0
        self._ground = np.zeros(2**16, bool)

    @property
    def total(self) -> int:
        """How many points were added."""
        return sum(int(count.sum()) for count in self.counts.values())

    def classified(self, scan: int, *, ground: bool) -> None:
        """Say whether a scan's classes tell ground from the rest."""
        self._ground[scan] = ground

    def add(self, xyz: Floats, category: Any, block: Integers, scan: int) -> None:
        """Add points that lie in blocks.

        Parameters
        ----------
        xyz : (n, 3) array
            Metres, in the map.
        category : (n,) uint8 array
            ASPRS classes.
        block : (n,) int64 array
            Number of the block of each.
        scan : int
            Which scan they come from.
        """
        if len(block) == 0:
            return
        order = np.argsort(block, kind="stable")
        numbers, begins = np.unique(block[order], return_index=True)
        for number, rows in zip(numbers.tolist(), np.split(order, begins[1:]), strict=True):
            west, south = self.site.corner(number)
            records = np.empty(len(rows), RECORD)
            for name, column, origin in (("x", 0, west), ("y", 1, south), ("z", 2, 0.0)):
                records[name] = np.rint((xyz[rows, column] - origin) * _MM)
            records["category"], records["scan"] = category[rows], scan
            self._kept.setdefault(number, []).append(records)
        self.counts[scan] += np.bincount(category, minlength=256)
        self._in_memory += len(block)
        if self._in_memory > MOST_KEPT:
            self._flush()

    def _flush(self) -> None:
        for number, parts in self._kept.items():
            with (self._folder / f"{number}.points").open("ab") as file:
                for part in parts:
                    part.tofile(file)
        self._kept, self._in_memory = {}, 0

    def points(self, block: int, margin_m: float = 0.0) -> tuple[Floats, Booleans]:
        """Return the points of a block and of a margin around it, each once, in a fixed order.

        Parameters
        ----------
        block : int
            Number of the block.
        margin_m : float
            Up to how far around it, metres; at most a block, and less than 100 m.

        Returns
        -------
        xyz : (n, 3) array
            Metres from the block's south-west corner; heights as they are.
        ground : (n,) bool array
            Whether a point is road by its class, or by lack of any.
        """
        west, south = self.site.corner(block)
        low, high = -margin_m * _MM, (BLOCK_M + margin_m) * _MM
        parts = []
        for number in self.site.neighbours(block).tolist() if margin_m else [block]:
            records = self._records(number)
            for name, shift in zip("xy", self.site.corner(number), strict=True):
                records[name] += np.int32((shift - (west if name == "x" else south)) * _MM)
            if number != block:
                x, y = records["x"], records["y"]
                records = records[(x >= low) & (x < high) & (y >= low) & (y < high)]
            parts.append(records)
        records = np.concatenate(parts)
        records = records[~never_road(records["category"])]
        by_class = self._ground[records["scan"]]
        return _each_once(records, ~by_class | is_road_class(records["category"]))

    def _records(self, block: int) -> Any:
        parts = list(self._kept.get(block, []))
        file = self._folder / f"{block}.points"
        if file.exists():
            parts.append(np.fromfile(file, RECORD))
        return np.concatenate(parts) if parts else np.empty(0, RECORD)


def _each_once(records: Any, ground: Booleans) -> tuple[Floats, Booleans]:
    """Sort points; of equal ones, as tiles that overlap give them, keep one, rather as ground."""
    if len(records) == 0:
        return np.empty((0, 3)), np.empty(0, bool)
    bottom = int(records["z"].min())
    tall = np.minimum(records["z"].astype(np.int64) - bottom, _MOST_TALL)
    key = (records["y"].astype(np.int64) + _SHIFT) << 20
    key = ((key | (records["x"].astype(np.int64) + _SHIFT)) << 22 | tall) << 1 | ~ground
    key.sort()
    new = np.ones(len(key), bool)
    new[1:] = np.diff(key >> 1) != 0
    key = key[new]
    place = key >> 1
    columns = [
        (place >> 22 & 0xFFFFF) - _SHIFT, (place >> 42) - _SHIFT, (place & _MOST_TALL) + bottom
    ]  # fmt: skip
    return np.column_stack(columns) / _MM, (key & 1) == 0
