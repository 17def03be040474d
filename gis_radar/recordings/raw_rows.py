"""Rows of a recording as arrays in the file's precision, read faster than by `Recording.read`.

They are checked like those of :meth:`Recording.read` and refused with the same messages: compiled
code finds whether a batch is sound, and only where it may not be, the full checks run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from gis_radar.base import Floats, compiled, in_known_years
from gis_radar.recordings.recording import COLUMNS, FARTHEST_M, Recording, RowChecks
from gis_radar.recordings.units import FARTHEST_RADAR_M, LEAST_CHECKED, LEAST_EXTENT_M

RAW_COLUMNS = COLUMNS[:-1]  # all but the radar cross section, which few ask for
_CHECKED_SHARE = 0.999  # share of a limit from which the full checks run, too


@dataclass(frozen=True, kw_only=True)
class RawRows:
    """Some consecutive rows of a recording.

    Parameters
    ----------
    time : (n,) float64 array
        UNIX seconds, ascending.
    x, y, z, range_rate, rcs : (n,) arrays
        As in :class:`Detections`; float32 where all are float32 in the file, else float64. `rcs`
        is empty where it was not asked for.
    without_height : bool
        Whether the detections read so far have no height; False before the first one.
    """

    time: Floats
    x: Floats
    y: Floats
    z: Floats
    range_rate: Floats
    rcs: Floats
    without_height: bool = False

    def __len__(self) -> int:
        return len(self.time)


def read_raw(
    recording: Recording, *, rcs: bool, begin: float = -np.inf, end: float = np.inf
) -> Iterator[RawRows]:
    """Read a recording in batches, in bounded memory.

    Parameters
    ----------
    recording : Recording
        The recording.
    rcs : bool
        Whether radar cross sections are needed.
    begin, end : float
        UNIX seconds: batches without a row between them are left out.

    Yields
    ------
    RawRows
        Consecutive rows; a frame may go on in the next batch.

    Raises
    ------
    InputError
        As of :meth:`Recording.read`.
    """
    names = COLUMNS if rcs else RAW_COLUMNS
    before, batches = recording.batches_since(begin, names)
    checks = RowChecks(path=recording.path, row=before)
    with checks.reading():
        for batch in batches:
            rows = _columns(batch, rcs=rcs)
            sound, without_height = _are_sound(rows, checks) if rows is not None else (False, None)
            if sound and rows is not None:
                checks.accept(rows.time, without_height=without_height)
            else:
                checked = _checked(batch, checks)
                rows = checked if rows is None else rows
            if len(rows) and rows.time[0] > end:
                return
            if len(rows) and rows.time[-1] >= begin:
                yield replace(rows, without_height=bool(checks.without_height))


def _columns(batch: pa.RecordBatch, *, rcs: bool) -> RawRows | None:
    """Return the columns of a batch as they are; None where one is neither float64 nor float32."""
    names = COLUMNS if rcs else RAW_COLUMNS
    kinds = {batch.column(name).type for name in names}
    if not kinds <= {pa.float32(), pa.float64()}:
        return None
    time, *columns = (batch.column(name).to_numpy(zero_copy_only=False) for name in names)
    kind = np.result_type(*columns)
    x, y, z, rate, *rest = (np.asarray(values, kind) for values in columns)
    rcs_column = rest[0] if rest else x[:0]
    return RawRows(
        time=np.asarray(time, np.float64), x=x, y=y, z=z, range_rate=rate, rcs=rcs_column
    )


def _checked(batch: pa.RecordBatch, checks: RowChecks) -> RawRows:
    """Return the rows of a batch after the full checks, those of `Recording.read`."""
    if "rcs" not in batch.schema.names:
        batch = batch.append_column("rcs", pa.nulls(len(batch), pa.float32()))
    rows = checks.take(batch)
    x, y, z = np.ascontiguousarray(rows.points.T)
    rate, rcs = rows.range_rate, rows.rcs
    return RawRows(time=rows.time, x=x, y=y, z=z, range_rate=rate, rcs=rcs)


def _are_sound(rows: RawRows, checks: RowChecks) -> tuple[bool, bool | None]:
    """Return whether rows are surely sound, and whether detections have no height so far."""
    if len(rows) == 0:
        return True, checks.without_height
    sound, present, flat, far, wide = _check_rows(rows.time, rows.x, rows.y, rows.z, checks.last)
    sound &= bool(in_known_years(rows.time[[0, -1]]).all())
    without_height = checks.without_height if present == 0 else flat > 0
    sound &= flat in {0, present} and checks.without_height in {None, without_height}
    if present >= LEAST_CHECKED:
        sound &= 2 * far < present and wide
    return sound, without_height


@compiled
def _check_rows(  # pragma: no cover - compiled
    time: Floats, xs: Floats, ys: Floats, zs: Floats, last: float
) -> tuple[bool, int, int, int, bool]:
    """Check times and positions, and count detections.

    Returns
    -------
    sound : bool
        Whether times (s) ascend from `last`, and positions (m) are within `FARTHEST_M` or missing.
    present, flat, far : int
        Numbers of detections, of those without height, of those beyond any radar.
    wide : bool
        Whether detections are in more than one spot.
    """
    sound, present, flat, far = True, 0, 0, 0
    far_m2 = (_CHECKED_SHARE * FARTHEST_RADAR_M) ** 2
    west = south = np.inf
    east = north = -np.inf
    for k in range(len(time)):
        sound &= time[k] >= last
        last = time[k]
        x, y, z = xs[k], ys[k], zs[k]
        placed = (abs(x) <= FARTHEST_M) & (abs(y) <= FARTHEST_M)
        high = abs(z) <= FARTHEST_M
        gap = np.isnan(z)
        sound &= (placed & (high | gap)) | (gap & np.isnan(x) & np.isnan(y))
        present += placed
        flat += placed & gap
        far += x * x + y * y > far_m2
        if placed:
            west, east = min(west, x), max(east, x)
            south, north = min(south, y), max(north, y)
    wide = max(east - west, north - south) > LEAST_EXTENT_M / _CHECKED_SHARE
    return sound, present, flat, far, wide
