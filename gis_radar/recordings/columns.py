"""Map the fields of tables and point clouds to the columns of a recording."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gis_radar.base import Text, UsageError
from gis_radar.recordings.frames import Column, DamagedError, Frame, ReaderContext
from gis_radar.recordings.recording import COLUMNS
from gis_radar.recordings.units import refuse_degrees

# Names in radar drivers and data sets, compared without case and underscores, by priority.
COLUMN_NAMES: dict[str, tuple[str, ...]] = {
    "time": ("time", "timestamp", "t", "stamp"),
    "x": ("x", "x_m", "pos_x"),
    "y": ("y", "y_m", "pos_y"),
    "z": ("z", "z_m", "pos_z"),
    "range": ("range", "r", "distance", "range_m", "radius"),
    "azimuth": ("azimuth", "azimuth_angle", "azi", "az"),
    "azimuth_deg": ("azimuth_deg", "az_deg"),
    "elevation": ("elevation", "elevation_angle", "ele", "el"),
    "elevation_deg": ("elevation_deg", "el_deg"),
    "range_rate": (
        "range_rate", "doppler", "doppler_velocity", "doppler_speed", "radial_velocity",
        "radial_speed", "v_radial", "v_rad", "v_r", "velocity", "vel", "speed", "v",
    ),
    "rcs": ("rcs", "radar_cross_section", "rcs_dbsm", "rcs_dbm2"),
}  # fmt: skip
# Drivers' clouds for RViz keep the cross section here, in whole dBm2; amplitudes have no sign.
_SIGNED_RCS = "intensity"
_CARTESIAN, _POLAR = ("x", "y", "z"), ("range", "azimuth", "elevation")
TARGETS = tuple(COLUMN_NAMES)

Values = Callable[[str], Column]


# Damaged files hold any numbers: positions that are not finite are left out later, and counted.
@np.errstate(over="ignore", invalid="ignore")
def cartesian(distance: Column, azimuth: Column, elevation: Column) -> Column:
    """Return positions in the sensor frame from polar ones.

    Parameters
    ----------
    distance : (n,) array
        Metres.
    azimuth, elevation : (n,) array
        Radians: azimuth from x towards y (to the left), elevation from the x-y plane upwards, NaN
        where it is not measured.

    Returns
    -------
    (n, 3) float32 array
        x forward, y left, z up, metres; without an elevation z is NaN and x, y are at the distance.
    """
    flat = distance * np.where(np.isnan(elevation), 1.0, np.cos(elevation))
    points = np.empty((len(distance), 3), dtype=np.float32)
    points[:, 0] = flat * np.cos(azimuth)
    points[:, 1] = flat * np.sin(azimuth)
    points[:, 2] = distance * np.sin(elevation)
    return points


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Fields of a file that the columns of a recording are read from.

    Parameters
    ----------
    sources : mapping of str to str
        Field by column of a recording; a leading minus turns the sign.
    further : mapping of str to str
        Field by further column.
    rcs_from_intensity : bool
        Whether `rcs` is read from a field named `intensity`.
    """

    sources: Mapping[str, str]
    further: Mapping[str, str]
    rcs_from_intensity: bool = False

    @property
    def has_positions(self) -> bool:
        """Whether the fields hold positions."""
        return self._has(_CARTESIAN[:2]) or self._has(_POLAR[:2])

    @property
    def is_radar(self) -> bool:
        """Whether the fields hold positions and range rates, as only clouds of radars do."""
        return self.has_positions and "range_rate" in self.sources

    @np.errstate(over="ignore", invalid="ignore")
    def points(self, values: Values) -> Column:
        """Return positions, sensor frame, (n, 3) float32, m; z is NaN without elevation."""
        if self._has(_CARTESIAN[:2]):
            axes = [self._read(axis, values) for axis in _CARTESIAN]
            return np.column_stack(axes).astype(np.float32, copy=False)
        return cartesian(*(self._read(name, values) for name in _POLAR))

    @np.errstate(over="ignore", invalid="ignore")
    def column(self, name: str, values: Values) -> Column:
        """Return a column as float32, NaN where there is no field for it."""
        if name in self.sources:
            return np.asarray(self._read(name, values), dtype=np.float32)
        return np.full(len(self._read(self._anchor, values)), np.nan, dtype=np.float32)

    def explain(self, sensor: str, context: ReaderContext) -> None:
        """Report a field that is read as something else than its name."""
        if self.rcs_from_intensity:
            context.remark(
                Text(
                    "{}: rcs is the field {}: whole numbers with a sign, beside the range rate {}",
                    sensor,
                    self.sources["rcs"],
                    self.sources["range_rate"].removeprefix("-"),
                )
            )

    def frame(self, values: Values, **given: Any) -> Frame:
        """Return a frame of the fields' values; `given` are its further arguments."""
        return Frame(
            points=self.points(values),
            range_rate=self.column("range_rate", values),
            rcs=self.column("rcs", values),
            further={name: values(field) for name, field in self.further.items()},
            **given,
        )

    def _has(self, names: tuple[str, ...]) -> bool:
        return all(name in self.sources or f"{name}_deg" in self.sources for name in names)

    @property
    def _anchor(self) -> str:
        """A column with a field, by which the number of rows is known."""
        return "x" if "x" in self.sources else "range"

    def _read(self, name: str, values: Values) -> Column:
        """Return the values of a column, degrees as radians; NaN where there is no field for it."""
        if name in self.sources:
            read = _signed(self.sources[name], values)
            if name in _POLAR[1:]:
                refuse_degrees(read, self.sources[name].removeprefix("-"), name)
            return read
        if f"{name}_deg" in self.sources:
            read = _signed(self.sources[f"{name}_deg"], values)
            if name == "azimuth":
                refuse_degrees(read, self.sources["azimuth_deg"].removeprefix("-"), "azimuth_deg")
            return np.asarray(np.radians(read))
        return np.full(len(self._read(self._anchor, values)), np.nan, dtype=np.float32)


def find_layout(
    fields: Collection[str], columns: Mapping[str, str], *, kind: np.dtype[Any] | None = None
) -> Layout:
    """Find the columns of a recording among the fields of a file.

    Parameters
    ----------
    fields : collection of str
        Names as the file has them.
    columns : mapping of str to str
        Field by column of a recording, as the user gives them; these come first.
    kind : dtype, optional
        Types of a cloud's fields. By them, a field `intensity` of signed whole numbers beside a
        range rate is taken for the cross section, as in clouds of the ARS548 and the ARS430.

    Raises
    ------
    UsageError
        If the user names a field that is not there, or no column of a recording.
    """
    sources = {}
    for target, field in columns.items():
        if target not in TARGETS:
            raise UsageError(
                "columns: {} is no column of a recording",
                repr(target),
                hint=Text("known: {}", ", ".join(TARGETS)),
            )
        if field.removeprefix("-") not in fields:
            raise UsageError(
                "columns: no field {} for {}",
                repr(field.removeprefix("-")),
                target,
                hint=Text("fields: {}", ", ".join(fields)),
            )
        sources[target] = field
    taken = {field.removeprefix("-") for field in sources.values()}
    lower = {_folded_name(field): field for field in reversed(list(fields)) if field not in taken}
    for target, names in COLUMN_NAMES.items():
        found = next(
            (lower[_folded_name(name)] for name in names if _folded_name(name) in lower), None
        )
        # A field that the user names, in radians or degrees, replaces one that is found by name.
        given = any(name.removesuffix("_deg") == target.removesuffix("_deg") for name in columns)
        if found is not None and not given:
            sources[target] = found
    signed = _signed_rcs(lower, kind) if "range_rate" in sources else None
    if from_intensity := "rcs" not in sources and signed is not None:
        sources["rcs"] = str(signed)
    used = {field.removeprefix("-") for field in sources.values()}
    further = {
        f"{field}_" if field in COLUMNS else field: field for field in fields if field not in used
    }
    return Layout(sources=sources, further=further, rcs_from_intensity=from_intensity)


def _signed_rcs(fields: Mapping[str, str], kind: np.dtype[Any] | None) -> str | None:
    """Return the field `intensity` where it holds signed whole numbers."""
    field = fields.get(_SIGNED_RCS)
    return field if field and kind is not None and kind[field].base.kind == "i" else None


def _folded_name(name: str) -> str:
    """Return a name in small letters without blanks and underscores."""
    return name.strip().lower().replace("_", "").replace(" ", "")


def _signed(field: str, values: Values) -> Column:
    if field.startswith("-"):
        return np.negative(values(field[1:]), dtype=np.float32, casting="unsafe")
    return values(field)


# NumPy's types by the constants of `sensor_msgs/PointField`.
_POINT_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def message_rows(message: Any) -> Column:
    """Return the points of a `sensor_msgs/PointCloud2` as a structured array.

    Fields may be in any order, packed or with gaps, in either byte order.

    Raises
    ------
    DamagedError
        If a field is of an unknown type or is outside the point, or data are missing.
    """
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.count != 0]
    try:
        layout = np.dtype(
            {
                "names": [field.name for field in fields],
                "formats": [_numpy_type(field, order) for field in fields],
                "offsets": [field.offset for field in fields],
                "itemsize": message.point_step,
            }
        )
    except (KeyError, ValueError) as error:
        raise DamagedError(Text("fields of a cloud make no sense: {}", error)) from error
    height, width = message.height, message.width
    data = np.asarray(message.data, dtype=np.uint8)
    line = message.row_step if height > 1 else width * message.point_step
    if line < width * message.point_step or len(data) < height * line:
        raise DamagedError(Text("{:,} bytes for {} x {} points", len(data), height, width))
    lines = data[: height * line].reshape(height, line)[:, : width * message.point_step]
    packed = np.ascontiguousarray(lines).reshape(-1)
    return packed.view(layout) if lines.size else np.empty(0, dtype=layout)


def values_of(rows: Column) -> Values:
    """Return a function that reads the first number of a field in each row, in native order."""

    def read(name: str) -> Column:
        column = rows[name]
        flat = column if column.ndim == 1 else column[:, 0]
        return flat.astype(flat.dtype.newbyteorder("="))

    return read


def _numpy_type(field: Any, order: str) -> Any:
    kind = order + _POINT_FIELDS[field.datatype]
    return kind if field.count == 1 else (kind, (field.count,))
