"""Point clouds: rows of bytes with named fields, as in PointCloud2 messages and PCD files."""

from __future__ import annotations

from typing import Any

import numpy as np

from gis_radar.formats.columns import Layout, Values
from gis_radar.formats.frames import Column, DamagedError, Frame

# PointField's numbers for the types of numbers.
POINT_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def message_rows(message: Any) -> Column:
    """Return the points of a `sensor_msgs/PointCloud2` as a structured array.

    Fields may lie in any order, packed or with gaps, in either byte order.

    Raises
    ------
    DamagedError
        If a field is of an unknown type or lies outside the point, or data are missing.
    """
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.count != 0]
    try:
        layout = np.dtype(
            {
                "names": [field.name for field in fields],
                "formats": [_kind(field, order) for field in fields],
                "offsets": [field.offset for field in fields],
                "itemsize": message.point_step,
            }
        )
    except (KeyError, ValueError) as error:
        raise DamagedError(f"fields of a cloud make no sense: {error}") from error
    height, width = message.height, message.width
    data = np.asarray(message.data, dtype=np.uint8)
    line = message.row_step if height > 1 else width * message.point_step
    if line < width * message.point_step or len(data) < height * line:
        raise DamagedError(f"{len(data):,} bytes for {height} x {width} points")
    lines = data[: height * line].reshape(height, line)[:, : width * message.point_step]
    return np.ascontiguousarray(lines).reshape(-1).view(layout) if lines.size else _empty(layout)


def values_of(rows: Column) -> Values:
    """Return how to read a field of structured rows: native numbers, the first of several."""

    def read(name: str) -> Column:
        column = rows[name]
        flat = column if column.ndim == 1 else column[:, 0]
        return flat.astype(flat.dtype.newbyteorder("="))

    return read


def frame_of(rows: Column, layout: Layout, **known: Any) -> Frame:
    """Return a frame of structured rows; see :meth:`Layout.frame`."""
    return layout.frame(values_of(rows), **known)


def _kind(field: Any, order: str) -> Any:
    kind = order + POINT_FIELDS[field.datatype]
    return kind if field.count == 1 else (kind, (field.count,))


def _empty(layout: np.dtype[Any]) -> Column:
    return np.empty(0, dtype=layout)
