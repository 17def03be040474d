"""Poses: position and orientation of a sensor, their uncertainty, and points moved by them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import shapely
from pyproj import CRS

from gis_radar.base import (
    Booleans,
    Floats,
    InputError,
    Text,
    as_points,
    atomic_write,
    axes_or_new,
    card,
    label_map,
    metric_crs,
    name_of,
    placed,
    require_kinds,
    require_on_earth,
    tr,
)
from gis_radar.poses.evidence import Evidence, non_negative_sigma, parse_covariance, parse_sigma

ANGLES = ("yaw", "pitch", "roll")
POSITION = ("easting", "northing", "height")
REQUIRED = ("sensor", "crs", *POSITION, *ANGLES)
_EVIDENCE = ("fitness", "observable", "method", "time", "frames")  # shown on a card
_MOST_RANGE_M, _MOST_HEIGHT_M = 10_000.0, 10_000.0  # larger values are mistakes of units
_QUATERNION_TOLERANCE_DEG = 0.01  # 5 cm at 300 m; documented in docs/frames.md


@dataclass(frozen=True, kw_only=True)
class View:
    """The field of view of a sensor: full opening angles about its x axis, and a range.

    Parameters
    ----------
    azimuth_deg, elevation_deg : float
        Full opening angles, degrees.
    min_range_m, max_range_m : float
        Slant range, metres.

    Examples
    --------
    >>> import numpy as np
    >>> ahead, aside = [50.0, 0.0, 0.0], [50.0, 60.0, 0.0]
    >>> View(azimuth_deg=90).sees(np.array([ahead, aside])).tolist()
    [True, False]
    """

    azimuth_deg: float = 120.0
    elevation_deg: float = 30.0
    min_range_m: float = 1.0
    max_range_m: float = 300.0

    def __post_init__(self) -> None:
        require_kinds(self)
        if not 0.0 < self.azimuth_deg <= 360.0:
            raise InputError("view: azimuth_deg is {}, expected 0 to 360", self.azimuth_deg)
        if not 0.0 < self.elevation_deg <= 180.0:
            raise InputError("view: elevation_deg is {}, expected 0 to 180", self.elevation_deg)
        if not 0.0 <= self.min_range_m < self.max_range_m <= _MOST_RANGE_M:
            raise InputError(
                "view: range is {} to {} m, expected ascending numbers up to {:.0f}",
                self.min_range_m,
                self.max_range_m,
                _MOST_RANGE_M,
            )

    def sees(self, points: Floats) -> Booleans:
        """Return which points are within range, azimuth and elevation.

        Parameters
        ----------
        points : (n, 3) array
            Sensor frame, metres; where z is NaN, the elevation is not checked.

        Returns
        -------
        (n,) bool array
        """
        x, y, z = as_points(points).T
        flat_m = np.hypot(x, y)
        height_m = np.nan_to_num(z, nan=0.0)
        slant_m = np.hypot(flat_m, height_m)
        azimuth = np.abs(np.arctan2(y, x)) <= math.radians(self.azimuth_deg) / 2
        elevation = np.abs(np.arctan2(height_m, flat_m)) <= math.radians(self.elevation_deg) / 2
        within = (slant_m >= self.min_range_m) & (slant_m <= self.max_range_m)
        return np.asarray(azimuth & elevation & within)


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Position and orientation of a sensor: rotation and translation sensor -> map.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    crs : CRS
        The map frame: projected, metric, z up.
    easting, northing, height : float
        Position in the map frame, metres.
    yaw, pitch, roll : float
        Degrees, intrinsic Z-Y-X: `R_map_sensor = Rz(yaw) Ry(pitch) Rx(roll)`. Yaw counts
        counter-clockwise from grid east, pitch > 0 looks down.
    view : View, optional
        Its field of view; None where not stated.
    evidence : dict
        Further fields of the pose file (sigma, covariance, time, method, ...), kept as read.
    """

    sensor: str
    crs: CRS
    easting: float
    northing: float
    height: float
    yaw: float
    pitch: float
    roll: float
    view: View | None = None
    evidence: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_kinds(self, what=Text("pose of {}", self.sensor))
        crs = metric_crs(self.crs, what=Text("pose of {}", self.sensor))
        object.__setattr__(self, "crs", crs)

    @property
    def position(self) -> Floats:
        """Position of the sensor in the map frame, (3,) metres."""
        return np.array([self.easting, self.northing, self.height])

    @property
    def R_map_sensor(self) -> Floats:  # noqa: N802 - frames name a rotation
        """Rotation from the sensor frame to the map frame, (3, 3)."""
        return np.asarray(self._rotation().as_matrix())

    @property
    def quaternion(self) -> Floats:
        """The rotation as (x, y, z, w) with w >= 0."""
        return np.asarray(self._rotation().as_quat(canonical=True))

    def _rotation(self) -> scipy.spatial.transform.Rotation:
        angles = [self.yaw, self.pitch, self.roll]
        return scipy.spatial.transform.Rotation.from_euler("ZYX", angles, degrees=True)

    def to_map(self, points: Floats, *, road_m: float = math.nan) -> Floats:
        """Move points from the sensor frame to the map.

        Parameters
        ----------
        points : (n, 3) array
            x forward, y left, z up, metres. Where z is NaN, the sensor measures no elevation, and
            x and y are at the slant range.
        road_m : float
            Height of the road in the map, metres: points without elevation are placed on it, or at
            the sensor's height where it is NaN.

        Returns
        -------
        (n, 3) float64 array
            Easting, northing, height, metres. A point without elevation whose range is less than
            the sensor's height over the road is placed under the sensor.
        """
        # Not a matrix product: its last digits depend on the number of points and the machine. The
        # loop that counts hits adds in this order, too, so both give the same digits.
        points = as_points(points)
        x, y, z = points.T
        turned = np.stack([(x * r[0] + z * r[2]) + y * r[1] for r in self.R_map_sensor], axis=1)
        no_elevation = np.isnan(points[:, 2]) & ~np.isnan(points[:, 0])
        if no_elevation.any():
            drop_m = 0.0 if math.isnan(road_m) else self.height - road_m
            turned[no_elevation] = self._on_plane(points[no_elevation], drop_m)
        return np.asarray(turned + self.position)

    def _on_plane(self, points: Floats, drop_m: float) -> Floats:
        """Return points projected to a plane `drop_m` below the sensor, relative to it, map axes.

        The slant range stays, the azimuth is that of the sensor's x and y turned into the map.
        """
        x, y = points[:, 0], points[:, 1]
        direction = np.stack([x * r[0] + y * r[1] for r in self.R_map_sensor[:2]], axis=1)
        range_m = np.hypot(x, y)
        flat_m = np.sqrt(np.maximum(range_m**2 - drop_m**2, 0.0))
        length = np.hypot(direction[:, 0], direction[:, 1])
        direction *= np.divide(flat_m, length, out=np.zeros_like(flat_m), where=length > 0.0)[
            :, None
        ]
        return np.column_stack([direction, np.full(len(points), -drop_m)])

    def to_sensor(self, points: Floats) -> Floats:
        """Move (n, 3) points from the map (easting, northing, height) to the sensor frame."""
        return (as_points(points) - self.position) @ self.R_map_sensor

    def with_view(self, view: View) -> Pose:
        """Return the same pose with a view, unless it has one."""
        return self if self.view is not None else replace(self, view=view)

    def as_dict(self) -> dict[str, Any]:
        """Return what a pose file holds, ready for JSON."""
        record = {
            "sensor": self.sensor,
            "crs": name_of(self.crs),
            **{name: getattr(self, name) for name in (*POSITION, *ANGLES)},
            "quaternion": self.quaternion.tolist(),
            **self.evidence,
        }
        return record if self.view is None else record | {"view": vars(self.view)}

    def write(self, path: str | Path) -> None:
        """Write the pose as JSON, whole or not at all.

        Examples
        --------
        >>> import gis_radar as gr
        >>> pose = gr.read_pose(gr.sample_folder() / "R1.json")
        >>> pose.write("R1.json")
        >>> gr.read_pose("R1.json") == pose
        True
        """
        with atomic_write(Path(path)) as part:
            part.write_text(json.dumps(self.as_dict(), indent=1) + "\n", encoding="utf-8")

    def outline(self) -> shapely.Polygon:
        """Return the view's area in the map, seen from above.

        The outline is the arc at elevation 0 of the sensor frame, rotated by yaw, pitch and roll,
        projected to the ground. A pose without a view gets the default one.
        """
        view = self.view or View()
        half = math.radians(view.azimuth_deg) / 2
        steps = max(2, math.ceil(view.azimuth_deg / _ARC_DEG) + 1)
        angle = np.linspace(-half, half, steps)
        rays = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(steps)])
        flat = (rays @ self.R_map_sensor.T)[:, :2]
        place, reaches = self.position[:2], (view.max_range_m, view.min_range_m)
        outer, inner = (place + flat * reach for reach in reaches)
        if view.azimuth_deg >= 360.0:
            return shapely.Polygon(outer, [inner])
        return shapely.Polygon(np.concatenate([outer, inner[::-1]]))

    def parsed_evidence(self) -> Evidence:
        """Return the evidence, parsed and checked.

        Raises
        ------
        InputError
            If the covariance is not 6 x 6, symmetric and positive, or a sigma is negative.
        """
        what, stated = Text("pose of {}", self.sensor), self.evidence
        scale = stated.get("range_scale")  # a text where none could be fitted
        sigma = scale.get("sigma") if isinstance(scale, Mapping) else None
        return Evidence(
            range_scale_sigma=non_negative_sigma(
                0.0 if sigma is None else sigma, "range_scale", what
            ),
            sigma=parse_sigma(stated.get("sigma"), what),
            covariance=parse_covariance(stated.get("covariance"), what),
            method=str(stated.get("method") or ""),
            time=str(stated.get("time") or ""),
        )

    def plane_covariance(self) -> Floats | None:
        """Return the covariance of easting and northing, (2, 2) m^2, or None where not known."""
        return self.parsed_evidence().plane_covariance()

    def plot(self, ax: Any = None, *, reach_m: float | None = None, **style: Any) -> Any:
        """Draw the sensor, its direction and view, and the 95 % ellipse of its position.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Axes in metres of the map; those of a new figure without it.
        reach_m : float, optional
            Largest range to which the view is drawn, metres.
        **style
            Properties of the matplotlib patch that shows the view.

        Returns
        -------
        matplotlib Axes
        """
        ax = axes_or_new(ax)
        view = self.view or View()
        far_m = min(reach_m or view.max_range_m, view.max_range_m)
        shown = replace(view, min_range_m=min(view.min_range_m, far_m / 2), max_range_m=far_m)
        outline = replace(self, view=shown).outline()
        look: dict[str, Any] = {"color": "#1d4ed8", "alpha": 0.15, "linewidth": 0}
        ax.fill(*outline.exterior.xy, **look | style)
        covariance = self.plane_covariance()
        ring = None if covariance is None else ellipse(self.position[:2], covariance)
        draw_sensor(ax, self.position, self.R_map_sensor[:2, 0] * far_m / 5, ring, self.sensor)
        label_map(ax)
        return ax

    def _repr_html_(self) -> str:
        sigma = self.parsed_evidence().sigma
        units = dict.fromkeys(POSITION, "m") | dict.fromkeys(ANGLES, "deg")
        values = {
            name: f"{getattr(self, name):.3f} {unit}"
            + (f" \u00b1 {sigma[name]:.2g}" if name in sigma else "")
            for name, unit in units.items()
        }
        known = {name: self.evidence[name] for name in _EVIDENCE if name in self.evidence}
        return card(f"Pose of {self.sensor}", {"crs": name_of(self.crs), **values, **known})

    def __repr__(self) -> str:
        return (
            f"Pose({self.sensor}: {self.easting:.2f} E {self.northing:.2f} N "
            f"{self.height:.2f} m, yaw {self.yaw:.2f} pitch {self.pitch:.2f} roll {self.roll:.2f})"
        )


def pose_from_dict(record: Mapping[str, Any], *, what: str) -> Pose:
    """Build a pose from the fields of a pose file.

    Parameters
    ----------
    record : mapping
        Fields of a pose file. Angles count; a quaternion beside them must agree.
    what : str
        Source of the record; begins error messages.

    Raises
    ------
    InputError
        If a field is missing, is not a finite number, is no place on the earth, or contradicts
        another.
    """
    missing = [name for name in REQUIRED if record.get(name) is None]
    if missing:
        raise InputError("{}: pose lacks {}", what, ", ".join(missing))
    numbers = {name: _number(record[name], f"{what}: {name}") for name in (*POSITION, *ANGLES)}
    known = {*REQUIRED, "quaternion", "view"}
    sensor = record["sensor"]
    if not isinstance(sensor, str) or not sensor.strip() or not sensor.isprintable():
        raise InputError("{}: sensor is {}, expected a name", what, repr(sensor))
    pose = Pose(
        sensor=sensor,
        crs=metric_crs(record["crs"], what=Text("{}: crs", what)),
        **numbers,
        view=_view(record.get("view"), what),
        evidence={name: value for name, value in record.items() if name not in known},
    )
    require_on_earth(pose.crs, pose.easting, pose.northing, what=what)
    if abs(pose.height) > _MOST_HEIGHT_M:
        raise InputError("{}: height is {:g}, expected metres", what, pose.height)
    _check_quaternion(pose, record.get("quaternion"), what)
    with placed(what):
        pose.parsed_evidence()
    return pose


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError("{} is {}, expected a finite number", what, repr(value))
    return float(value)


def _view(record: Any, what: str) -> View | None:
    """Return the view of a pose file's record, checked; None where there is none."""
    if record is None:
        return None
    names = View.__dataclass_fields__
    if not isinstance(record, dict) or (unknown := record.keys() - names.keys()):
        bad = record if not isinstance(record, dict) else sorted(unknown)
        raise InputError("{}: view has {}, expected {}", what, repr(bad), ", ".join(names))
    values = {
        name: _number(value, Text("{}: view.{}", what, name)) for name, value in record.items()
    }
    with placed(what):
        return View(**values)


def _check_quaternion(pose: Pose, quaternion: Any, what: str) -> None:
    """Refuse a quaternion that contradicts the angles of a pose."""
    if quaternion is None:
        return
    if not isinstance(quaternion, list | tuple) or len(quaternion) != 4:
        raise InputError("{}: quaternion is {}, expected [x, y, z, w]", what, repr(quaternion))
    values = [_number(value, Text("{}: quaternion", what)) for value in quaternion]
    if abs(math.hypot(*values) - 1.0) > 1e-3:
        raise InputError("{}: quaternion has length {:.4f}, expected 1", what, math.hypot(*values))
    rotation = scipy.spatial.transform.Rotation
    turn = rotation.from_quat(values).inv() * rotation.from_matrix(pose.R_map_sensor)
    apart_deg = math.degrees(turn.magnitude())
    if apart_deg > _QUATERNION_TOLERANCE_DEG:
        raise InputError(
            "{}: quaternion and angles differ by {:.3f} deg",
            what,
            apart_deg,
            hint="angles are intrinsic Z-Y-X, the quaternion is x, y, z, w; drop one of them",
        )


_ARC_DEG = 2.0  # between points of a drawn arc: 5 cm off at 300 m
_CHI2_95 = -2.0 * math.log(0.05)  # of two degrees of freedom
_INK = "#111827"


def ellipse(centre: Floats, covariance: Floats) -> shapely.Polygon:
    """Return the 95 % confidence ellipse of a position, in metres of the map.

    Parameters
    ----------
    centre : (2,) array
        Easting, northing, metres.
    covariance : (2, 2) array
        Covariance of easting and northing, m^2.
    """
    values, axes = np.linalg.eigh(covariance)
    half_m = np.sqrt(np.maximum(values, 0.0) * _CHI2_95)
    angle = np.linspace(0.0, 2 * math.pi, 73)
    return shapely.Polygon(
        centre + np.column_stack([np.cos(angle), np.sin(angle)]) * half_m @ axes.T
    )


def draw_sensor(
    ax: Any, position: Floats, ahead: Floats, ring: shapely.Polygon | None, label: str
) -> None:
    """Draw a sensor, an arrow along its x axis, and the confidence ellipse of its position.

    Parameters
    ----------
    ax : matplotlib Axes
        Axes in metres of the map.
    position : (2,) or (3,) array
        Easting and northing, metres.
    ahead : (2,) array
        Vector of the arrow, metres of the map.
    ring : Polygon, optional
        The confidence ellipse.
    label : str
        Name of the sensor in the legend.
    """
    place = tuple(position[:2])
    arrow = {"arrowstyle": "-|>", "color": _INK, "linewidth": 1.5, "shrinkA": 0, "shrinkB": 0}
    tip = (position[0] + ahead[0], position[1] + ahead[1])
    ax.annotate("", tip, place, arrowprops=arrow, zorder=5, annotation_clip=True)
    ax.scatter(*place, s=34, color=_INK, marker="^", label=label, zorder=6)
    if ring is not None:
        x, y = ring.exterior.xy
        ax.plot(x, y, color=_INK, linewidth=1.0, label=tr("95 % ellipse of the place"), zorder=5)
