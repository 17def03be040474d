"""Pose files: one pose as JSON, or a track of poses over time as CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from gis_radar.base import (
    Floats,
    InputError,
    Integers,
    Text,
    atomic_write,
    iso_from_step,
    metric_crs,
    name_of,
    read_json,
    seconds_from_iso,
    step_of,
    table_card,
)
from gis_radar.poses.pose import ANGLES, POSITION, Pose, View, pose_from_dict

_VIEW_FIELDS = tuple(View.__dataclass_fields__)
_SIGMA_FIELDS = tuple(f"sigma_{name}" for name in (*POSITION, *ANGLES))
_QUATERNION_FIELDS = ("quaternion_x", "quaternion_y", "quaternion_z", "quaternion_w")
TRACK_FIELDS = ("time", "sensor", "crs", *POSITION, *ANGLES, *_QUATERNION_FIELDS, *_SIGMA_FIELDS,
                "event", "vehicles", "fitness")  # fmt: skip
_NUMBERS = {"vehicles": int, "fitness": float}  # evidence that is a number; all other is text
DECIMALS = 6  # of metres and degrees
# A warning is given where the standard deviation of place or yaw exceeds these for so long.
_UNCERTAIN_M, _UNCERTAIN_DEG, _UNCERTAIN_S = 1.0, 1.0, 60.0
# How long after the end of its track a pose is taken without a warning; as long as rows are apart,
# if that is more: poses written by hand hold until they are changed.
LATER_S = 3600.0


@dataclass(frozen=True, kw_only=True)
class PoseTrack:
    """The poses of one sensor, each valid from its time until the next one's.

    Parameters
    ----------
    poses : tuple of Pose
        At least one, all of one sensor and one coordinate system.
    since : (n,) array
        UNIX seconds from which each pose holds, ascending; the first holds before, too.
    """

    poses: tuple[Pose, ...]
    since: Floats

    @property
    def sensor(self) -> str:
        """Name of the sensor."""
        return self.poses[0].sensor

    def at(self, time: Floats) -> Integers:
        """Return which pose holds at each time (UNIX seconds), as indices into `poses`."""
        return np.maximum(np.searchsorted(self.since, time, side="right") - 1, 0)

    def runs(self, time: Floats) -> Iterator[tuple[int, int, int]]:
        """Yield each pose's index, with begin and end of its run in ascending times (UNIX s)."""
        first, last = self.at(time[[0, -1]]).tolist()
        borders = np.searchsorted(time, self.since[first + 1 : last + 1]).tolist()
        for index, (begin, end) in enumerate(pairwise([0, *borders, len(time)]), start=first):
            if begin < end:
                yield index, begin, end

    def has_other_view(self, given: Mapping[str, float]) -> bool:
        """Say whether a pose has a view of its own that differs from these values."""
        own = [pose.view for pose in self.poses if pose.view is not None]
        return any(getattr(each, name) != value for each in own for name, value in given.items())

    def with_view(self, view: View) -> PoseTrack:
        """Return the same track with a view wherever a pose has none."""
        return replace(self, poses=tuple(pose.with_view(view) for pose in self.poses))

    def warn_uncertain(self, begin: float, end: float) -> Iterator[Text]:
        """Yield a warning for each span of a minute or more in which the pose is uncertain.

        And one where the times are not of the track: another day's, or another time zone's.

        Parameters
        ----------
        begin, end : float
            Times between which spans count, UNIX seconds.
        """
        first, last = self.since[[0, -1]]
        apart_s = np.diff(self.since).max() if len(self.since) > 1 else math.inf
        if math.isfinite(first) and (end < first or begin > last + max(apart_s, LATER_S)):
            yield Text(
                "{}: recorded from {} to {}, but its pose track is of {} to {}: its nearest pose "
                "was taken; is it the track of another day or time zone?",
                self.sensor,
                *map(iso_from_step, step_of(np.array([begin, end, first, last])).tolist()),
            )
        sigmas = [pose.parsed_evidence().sigma for pose in self.poses]
        sigma_m = np.array(
            [math.hypot(s.get("easting", 0.0), s.get("northing", 0.0)) for s in sigmas]
        )
        sigma_deg = np.array([s.get("yaw", 0.0) for s in sigmas])
        certain = (sigma_m <= _UNCERTAIN_M) & (sigma_deg <= _UNCERTAIN_DEG)
        borders = np.flatnonzero(np.diff(certain, prepend=True, append=True))
        times = np.clip(np.append(self.since, math.inf), begin, end)
        for first, last in borders.reshape(-1, 2).tolist():
            if len(certain) > 1 and times[last] - times[first] >= _UNCERTAIN_S:
                yield Text(
                    "{}: from {} to {} its pose track is uncertain by {:.1f} m and {:.1f} deg: "
                    "was it moved then? What is measured may lie in other lanes",
                    self.sensor,
                    *(iso_from_step(int(step)) for step in step_of(times[[first, last]])),
                    float(sigma_m[first:last].max()),
                    float(sigma_deg[first:last].max()),
                )

    def write(self, path: str | Path) -> None:
        """Write the track as CSV, whole or not at all.

        A row a pose: time, position, angles, quaternion (x, y, z, w; its sign does not jump from
        row to row), sigma in metres and degrees, then `event`, `vehicles`, `fitness` and the view
        where a pose has them. Unknown values stay empty.

        Parameters
        ----------
        path : str or Path
            The file. The times of the track must be finite.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        has_view = any(pose.view is not None for pose in self.poses)
        names = (*TRACK_FIELDS, *(_VIEW_FIELDS if has_view else ()))
        with atomic_write(Path(path)) as part, part.open("w", encoding="utf-8", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(names)
            quaternion = self.poses[0].quaternion
            for pose, since in zip(self.poses, self.since, strict=True):
                same_sign = pose.quaternion @ quaternion >= 0.0  # as the row before
                quaternion = pose.quaternion if same_sign else -pose.quaternion
                values = _row_of_pose(pose, float(since), quaternion)
                table.writerow([values.get(name, "") for name in names])

    def __repr__(self) -> str:
        return f"PoseTrack({self._title()})"

    def _title(self) -> str:
        if not math.isfinite(self.since[0]):
            return f"{self.sensor}: one pose, always"
        first, last = (iso_from_step(int(step)) for step in step_of(self.since[[0, -1]]))
        return f"{self.sensor}: {len(self.poses)} poses, {first} to {last}"

    def _repr_html_(self) -> str:
        names = (*POSITION, *ANGLES)
        begins = ["always"] if not math.isfinite(self.since[0]) else [
            iso_from_step(int(step)) for step in step_of(self.since)
        ]  # fmt: skip
        rows = [
            [begin, *(f"{getattr(pose, name):.3f}" for name in names), pose.evidence.get("event")]
            for begin, pose in zip(begins, self.poses, strict=True)
        ]
        units = [*(f"{name}, m" for name in POSITION), *(f"{name}, deg" for name in ANGLES)]
        return table_card(f"Poses of {self._title()}", ["since", *units, "event"], rows)


def as_pose(pose: Pose | str | Path) -> Pose:
    """Return a pose, read if it is a path."""
    return pose if isinstance(pose, Pose) else read_pose(pose)


def as_track(pose: Pose | PoseTrack | str | Path) -> PoseTrack:
    """Return a pose as a track that is valid at all times, a track as it is, or that of a file."""
    if isinstance(pose, str | Path):
        return read_track(pose)
    if isinstance(pose, PoseTrack):
        return pose
    return PoseTrack(poses=(pose,), since=np.array([-math.inf]))


def as_tracks(
    poses: Pose | PoseTrack | str | Path | Sequence[Pose | PoseTrack | str | Path],
) -> list[PoseTrack]:
    """Return a list of pose tracks from poses, tracks or paths, or from a single one of these."""
    given = [poses] if isinstance(poses, Pose | PoseTrack | str | Path) else poses
    return [as_track(pose) for pose in given]


def read_pose(path: str | Path) -> Pose:
    """Read one pose from JSON.

    Raises
    ------
    InputError
        If the file is not a pose; CrsError if its coordinate system is missing or not metric.

    Examples
    --------
    >>> import gis_radar as gr
    >>> gr.read_pose(gr.sample_folder() / "R1.json")
    Pose(R1: 690360.11 E 5336178.10 N 520.01 m, yaw 21.70 pitch 3.20 roll -0.80)
    """
    record = read_json(path, what="a pose")
    if not isinstance(record, dict):
        raise InputError("{}: not a pose: expected a JSON object with its fields", path)
    return pose_from_dict(record, what=str(path))


def _row_of_pose(pose: Pose, since: float, quaternion: Floats) -> dict[str, Any]:
    sigma = {f"sigma_{name}": value for name, value in pose.parsed_evidence().sigma.items()}
    numbers = {name: getattr(pose, name) for name in (*POSITION, *ANGLES)} | sigma
    fitness = pose.evidence.get("fitness")
    return {
        "time": iso_from_step(int(step_of(np.array([since]))[0])),
        "sensor": pose.sensor,
        "crs": name_of(pose.crs),
        **{name: round(value, DECIMALS) for name, value in numbers.items()},
        **dict(zip(_QUATERNION_FIELDS, quaternion.round(9).tolist(), strict=True)),
        "event": pose.evidence.get("event", ""),
        "vehicles": pose.evidence.get("vehicles", ""),
        "fitness": "" if fitness is None or math.isnan(fitness) else round(fitness, 3),
        **({} if pose.view is None else vars(pose.view)),
    }


def read_track(path: str | Path) -> PoseTrack:
    """Read a pose (JSON) or a pose track (CSV), whichever the file is.

    Rows of the event `rejected` repeat the pose that stays in force and count like any other.
    Columns `sigma_...` become the sigma of a pose's evidence, unknown columns its further entries.

    Raises
    ------
    InputError
        If the file is neither, holds several sensors, or its times do not ascend.

    Examples
    --------
    >>> import gis_radar as gr
    >>> gr.read_track(gr.sample_folder() / "R1.json")
    PoseTrack(R1: one pose, always)
    """
    if Path(path).suffix.lower() != ".csv":
        return as_track(read_pose(path))
    rows = _rows_of(Path(path))
    shared: dict[str, CRS] = {}
    poses = tuple(
        _pose_of_row(row, Text("{}: row {}", path, i), shared)
        for i, row in enumerate(rows, start=1)
    )
    since = np.array(
        [
            seconds_from_iso(row.get("time") or "", what=Text("{}: row {}: time", path, i))
            for i, row in enumerate(rows, start=1)
        ]
    )
    if len({(pose.sensor, pose.crs.to_wkt()) for pose in poses}) != 1:
        raise InputError("{}: a pose track has one sensor and one coordinate system", path)
    if np.any(np.diff(since) <= 0.0):
        late = int(np.flatnonzero(np.diff(since) <= 0.0)[0]) + 2
        raise InputError("{}: row {}: times of a pose track must ascend", path, late)
    return PoseTrack(poses=poses, since=since)


def _rows_of(path: Path) -> list[dict[str, str]]:
    """Return the rows of a track; refuse rows of unequal length, and a last row that may be cut."""
    text = _text(path)
    try:
        header, *rows = [row for row in csv.reader(text.splitlines()) if row] or [[]]
    except csv.Error as error:
        raise InputError("{}: not a pose track: {}", path, error) from error
    if not rows:
        raise InputError("{}: pose track without rows", path)
    for number, row in enumerate(rows, start=1):
        if len(row) != len(header):
            raise InputError(
                Text("{}: row {} has {} cells, the header {}", path, number, len(row), len(header))
                + (": cut off?" if number == len(rows) else "")
            )
    # The last line needs no line end (RFC 4180), but without one its last number may be truncated.
    # In files of `PoseTrack.write` it is a field of the view, equal in all rows: a value that no
    # other row has is truncated.
    has_view = tuple(header[: len(TRACK_FIELDS)]) == TRACK_FIELDS and header[-1] in _VIEW_FIELDS
    is_repeated = any(row[-1] == rows[-1][-1] for row in rows[:-1])
    if has_view and not is_repeated and not text.endswith("\n"):
        raise InputError("{}: row {} does not end: cut off?", path, len(rows))
    return [dict(zip(header, row, strict=True)) for row in rows]


def _pose_of_row(row: dict[str, Any], what: str, shared: dict[str, CRS]) -> Pose:
    """Return the pose of a row; `shared` caches coordinate systems, whose parsing is slow."""
    known = {"sensor", "crs", "quaternion", *_QUATERNION_FIELDS, *POSITION, *ANGLES, *_VIEW_FIELDS,
             *_SIGMA_FIELDS}  # fmt: skip
    record: dict[str, Any] = {"sensor": row.get("sensor") or None, "crs": None}
    if text := row.get("crs"):
        record["crs"] = shared.setdefault(text, metric_crs(shared.get(text, text), what=what))
    for name in (*POSITION, *ANGLES, *_VIEW_FIELDS):
        if text := row.get(name):
            record[name] = _parsed(text, f"{what}: {name}")
    sigma = {
        name.removeprefix("sigma_"): _parsed(text, f"{what}: {name}")
        for name in _SIGMA_FIELDS
        if (text := row.get(name))
    }
    if sigma:
        record["sigma"] = sigma
    view = {name: record.pop(name) for name in _VIEW_FIELDS if name in record}
    further: dict[str, Any] = {
        name: _parsed(text, f"{what}: {name}", _NUMBERS.get(name, str))
        for name, text in row.items()
        if name and text and name not in known
    }
    return pose_from_dict(further | record | ({"view": view} if view else {}), what=what)


def _parsed(text: str, what: str, kind: Callable[[str], Any] = float) -> Any:
    try:
        return kind(text)
    except ValueError as error:
        raise InputError("{} is {}, expected a number", what, repr(text)) from error


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or Text("not UTF-8 text")
        raise InputError("{}: cannot be read: {}", path, reason) from error
