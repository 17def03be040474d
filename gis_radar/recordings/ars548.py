"""The detection list of the Continental ARS548 RDI, as it travels in one UDP datagram.

Layout after the public struct declarations of robotics-upo/ars548_ros and tier4/nebula; big-endian
throughout, without padding.
"""

from __future__ import annotations

import struct

import numpy as np

from gis_radar.recordings.columns import cartesian
from gis_radar.recordings.frames import Column, Frame

PORT = 42102  # of the sensor by default, as GROUP
GROUP = "224.0.2.2"
SLOTS = 800  # detections in a list
SIZE = 35_336  # bytes of a datagram with a detection list
METHOD = 336  # SOME/IP method of a detection list
OTHER_METHODS = {329: "object list", 380: "sensor status", 396: "filter status"}

_HEAD = struct.Struct(">HHI")
_STAMP = struct.Struct(">IIB")
_STAMP_AT, _LIST_AT, _COUNT_AT = 36, 101, 35_309
_SYNCHRONISED = 1
_INVALID_POSITION = 0x01 | 0x04 | 0x10  # distance, azimuth, elevation
_INVALID_RATE = 0x40

DETECTION = np.dtype(
    [
        ("azimuth", ">f4"),
        ("azimuth_std", ">f4"),
        ("invalid", "u1"),
        ("elevation", ">f4"),
        ("elevation_std", ">f4"),
        ("range", ">f4"),
        ("range_std", ">f4"),
        ("range_rate", ">f4"),
        ("range_rate_std", ">f4"),
        ("rcs", "i1"),
        ("measurement_id", ">u2"),
        ("probability", "u1"),
        ("classification", "u1"),
        ("multi_target", "u1"),
        ("object_id", ">u2"),
        ("ambiguity", "u1"),
        ("sort_index", ">u2"),
    ]
)
KEPT = ("probability", "multi_target", "ambiguity", "classification", "object_id")


def method_of(payload: bytes) -> int | None:
    """Return the method of an ARS548 message, or None where the payload is none.

    The header of a message states its length, which must be that of the datagram.
    """
    if len(payload) < _HEAD.size:
        return None
    service, method, length = _HEAD.unpack_from(payload)
    known = method == METHOD or method in OTHER_METHODS
    return method if known and service == 0 and length + _HEAD.size == len(payload) else None


def read_detections(payload: bytes, *, sensor: str, recorder_time: float | None) -> Frame | None:
    """Decode a detection list.

    Parameters
    ----------
    payload : bytes
        What :func:`method_of` calls a detection list (336).
    sensor : str
        Who sent it.
    recorder_time : float or None
        When it was received, UNIX seconds.

    Returns
    -------
    Frame or None
        None where the list counts more detections than it has slots. `further` has, in percent,
        `probability` (that the detection exists), `multi_target` and `ambiguity` (that the speed is
        the right one of several), and `classification` and `object_id`.
    """
    (count,) = struct.unpack_from(">I", payload, _COUNT_AT)
    if len(payload) != SIZE or count > SLOTS:
        return None
    nanoseconds, seconds, status = _STAMP.unpack_from(payload, _STAMP_AT)
    rows = np.frombuffer(payload, DETECTION, count, _LIST_AT)
    points = cartesian(_native(rows, "range"), _native(rows, "azimuth"), _native(rows, "elevation"))
    rate = _native(rows, "range_rate")
    flags = rows["invalid"]
    if flags.any():
        points[(flags & _INVALID_POSITION) != 0] = np.nan
        rate = np.where(flags & _INVALID_RATE, np.float32(np.nan), rate)
    used = payload[: _LIST_AT + count * DETECTION.itemsize]
    return Frame(
        sensor=sensor,
        points=points,
        range_rate=rate,
        rcs=_native(rows, "rcs"),
        further={name: _native(rows, name) for name in KEPT},
        sensor_time=seconds + nanoseconds * 1e-9,
        recorder_time=recorder_time,
        synchronised=status == _SYNCHRONISED,
        identity=hash(used),
    )


def _native(rows: Column, name: str) -> Column:
    return rows[name].astype(np.float32)
