"""Extract traces of vehicles from a window: link moving detections to tracks, thin to samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from gis_radar.base import Booleans, Floats, Integers, compiled

WINDOW_FRAMES = 2000  # of the window, 100 s at 20 Hz (the paper's n_f)
LEAST_FRAMES = 100  # fewer are refused: 5 s show no traffic
MIN_SPEED_MPS = 0.15  # least absolute range rate of moving detections (the paper)
_SEGMENT_S = 8.0  # longer tracks are cut: a dense stream of vehicles may be linked without end
_WALK_MPS = 2.7  # slower tracks, by range rates and by displacement, may be of walkers
_MOST_SAMPLES = 6000  # most samples in all; cost grows in proportion
_LINK_S = 0.35  # longest gap in a track: a far vehicle is detected in one frame of four
RANGE_M = 1.5  # largest difference between change of range and Doppler: faces of one vehicle
# Largest displacement across the line of sight: a vehicle's size, and a speed without Doppler.
_ACROSS_M = 1.5
_ACROSS_MPS = 6.0
_MOST_RATE_CHANGE_MPS = 1.5  # largest difference of range rates in a track, as of a turning vehicle
# A track of fewer points is a false alarm, a slow track with a shorter path is a leaf.
_MIN_POINTS = 6
_MIN_PATH_M = 3.0
_LEAF_MPS = 1.5  # leaves have a lower median range rate
# Slow tracks are left out if they are a larger share of all: in gridlock up to 0.11 are slow, with
# 48 walkers in view 0.2 and more. The fit tolerates smaller shares as outliers.
MOST_WALKERS = 0.15
# Side of voxels, wider than a vehicle, and most samples of a track in each: enough to keep the
# proportion of its faces.
_VOXEL_M = 6.0
_PER_VOXEL = 8
CROWD_M = 10.0  # length over which samples of a vehicle share its offset (`Model.wander`)
# A track is of a vehicle that was hidden for up to _HIDDEN_S if it begins within _VEHICLE_M of the
# vehicle's predicted position, plus _STRAY_MPS times the time hidden.
_HIDDEN_S = 6.0
_VEHICLE_M = 5.0
_STRAY_MPS = 1.0
# Time over which the motion at a track's begin and end is averaged, and largest difference of range
# rates of one vehicle's tracks: more than _MOST_RATE_CHANGE_MPS, as it may turn while it is hidden.
_PACE_S = 0.5
_PACE_MPS = 3.0
_PACE_POINTS = 4  # least detections in _PACE_S: the median of three may be of a limb
# Length of a spell, within which samples of a vehicle share an error of elevation (`Model.bent`):
# much shorter than `Model.lasting`.
SPELL_S = 1.0

NONE = -1  # track number of detections on no track


@dataclass(frozen=True, kw_only=True)
class Moving:
    """Moving detections of a window.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds, ascending.
    points : (n, 3) array
        Sensor frame, metres.
    range_rate : (n,) array
        Range rates, m/s, positive when receding.
    frames : int
        Number of frames of the window.
    begin, end : float
        UNIX seconds of the first and last frame of the window.
    """

    time: Floats
    points: Floats
    range_rate: Floats
    frames: int
    begin: float
    end: float

    def __len__(self) -> int:
        return len(self.time)

    def where(self, keep: Booleans | Integers | slice) -> Moving:
        """Return the selected detections, of the same window."""
        rows = ("time", "points", "range_rate")
        return replace(self, **{name: getattr(self, name)[keep] for name in rows})


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Samples of a registration: moving detections on tracks, thinned.

    Parameters
    ----------
    points : (n, 3) array
        Sensor frame, metres.
    range_rate : (n,) array
        Range rates, m/s.
    track : (n,) array
        Number of the track, 0 to `tracks` - 1.
    tracks : int
        Number of tracks.
    elevation : float
        Half of the vertical opening of the view, radians: 99.5 % quantile of the elevations.
    spell : (n,) array, optional
        Number of each sample's spell of `SPELL_S` in its track, from 0; by default one spell.
    vehicle : (tracks,) array, optional
        Number of the vehicle of each track, from 0; by default each track is a vehicle.
    """

    points: Floats
    range_rate: Floats
    track: Integers
    tracks: int
    elevation: float
    spell: Integers | None = None
    vehicle: Integers | None = None

    @cached_property
    def crowd(self) -> Integers:
        """Number of samples of the same track in the same cell of `CROWD_M`, itself included."""
        cells = np.floor(self.points[:, :2] / CROWD_M).astype(np.int64)
        keys = np.column_stack([self.track, cells])
        _, number, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        return np.asarray(count[number.ravel()])

    @cached_property
    def vehicles(self) -> Integers:
        """Number of the vehicle of each track."""
        return np.arange(self.tracks) if self.vehicle is None else self.vehicle

    @cached_property
    def in_order(self) -> Integers:
        """Indices of the samples by track, and within a track by time."""
        return np.argsort(self.track, kind="stable")

    @cached_property
    def kept(self) -> dict[tuple[float, ...], Floats]:
        """Cache of values computed from these samples, by the constants used."""
        return {}

    @cached_property
    def spells(self) -> Integers:
        """Number of each sample's spell among all tracks: `track * longest + spell`."""
        spell = np.zeros(len(self), dtype=np.int64) if self.spell is None else self.spell
        return np.asarray(self.track * (int(spell.max(initial=0)) + 1) + spell)

    @cached_property
    def spell_reach(self) -> Floats:
        """Mean range of each track in each spell, (tracks, longest), metres; 0 without samples."""
        longest = 1 if self.spell is None else int(self.spell.max(initial=0)) + 1
        size = self.tracks * longest
        count = np.bincount(self.spells, minlength=size)
        reach = np.bincount(self.spells, weights=self.reach, minlength=size)
        return np.asarray((reach / np.maximum(count, 1)).reshape(self.tracks, longest))

    @cached_property
    def reach(self) -> Floats:
        """Ranges of the samples, metres."""
        return np.asarray(np.linalg.norm(self.points, axis=1), dtype=np.float64)

    @cached_property
    def upward(self) -> Floats:
        """Elevation angles of the samples, radians, positive upwards."""
        x, y, z = self.points.T
        return np.asarray(np.arctan2(z, np.hypot(x, y)), dtype=np.float64)

    def __len__(self) -> int:
        return len(self.track)

    def where(self, keep: Booleans) -> Samples:
        """Return the samples for which `keep` is true; tracks keep their numbers."""
        return replace(
            self,
            points=self.points[keep],
            range_rate=self.range_rate[keep],
            track=self.track[keep],
            spell=None if self.spell is None else self.spell[keep],
        )


def link_tracks(moving: Moving) -> Integers:
    """Link moving detections to tracks.

    Two detections are linked if the range changed by the Doppler, and azimuth and Doppler are
    similar; tracks longer than `_SEGMENT_S` are cut. Left out are tracks of few points (false
    alarms), slow tracks without displacement (leaves), and, if many tracks are no faster than
    walkers, these.

    Parameters
    ----------
    moving : Moving
        Moving detections of one window.

    Returns
    -------
    (n,) int64 array
        Number of the track of each detection; `NONE` for those on no track.
    """
    if len(moving) == 0:
        return np.empty(0, dtype=np.int64)
    time = moving.time - moving.time[0]
    x, y = moving.points[:, 0], moving.points[:, 1]
    range_m = np.linalg.norm(moving.points, axis=1)
    root = _track_roots(time, range_m, np.arctan2(y, x), moving.range_rate)
    table = pd.DataFrame({"root": root, "segment": (time / _SEGMENT_S).astype(np.int64)})
    number = np.asarray(table.groupby(["root", "segment"], sort=True).ngroup(), dtype=np.int64)
    is_vehicle = _is_vehicle(number, time, moving)
    renumbered = np.where(is_vehicle, np.cumsum(is_vehicle) - 1, NONE)
    return np.asarray(renumbered[number])


def _is_vehicle(number: Integers, time: Floats, moving: Moving) -> Booleans:
    """Return which tracks are long and fast enough to be of vehicles."""
    x, y, _ = moving.points.T
    columns = {"n": number, "x": x, "y": y, "rate": np.abs(moving.range_rate)}
    rows = pd.DataFrame(columns).groupby("n")
    early, late = rows.head(2).groupby("n").mean(), rows.tail(2).groupby("n").mean()
    path = np.hypot(late["x"] - early["x"], late["y"] - early["y"])
    extent = np.hypot(rows["x"].max() - rows["x"].min(), rows["y"].max() - rows["y"].min())
    moves = (path >= _MIN_PATH_M) & (path >= 0.5 * extent)
    streams = (rows["rate"].median() >= _LEAF_MPS) & (extent >= _MIN_PATH_M)
    plausible = (rows.size() >= _MIN_POINTS) & (moves | streams)
    fast = plausible & (_top_speed(number, time, moving) > _WALK_MPS)
    # in a queue vehicles are as slow as walkers: drop slow tracks only where they are many
    walkers = 1.0 - fast.sum() / max(plausible.sum(), 1)
    return np.asarray(fast if walkers > MOST_WALKERS else plausible)


def _top_speed(number: Integers, time: Floats, moving: Moving) -> Floats:
    """Return the top speed of each track, m/s: the larger one by range rates and by positions."""
    return np.maximum(_top_range_rate(number, time, moving), _speed_of_line(number, time, moving))


def _top_range_rate(number: Integers, time: Floats, moving: Moving) -> Floats:
    """Return the highest absolute range rate of each track, m/s, of medians over `_PACE_S`.

    A walker's limbs are up to 2.5 times as fast as the trunk; the median leaves them out.
    """
    rate = pd.Series(np.abs(moving.range_rate))
    spell = np.floor(time / _PACE_S).astype(np.int64)
    by_spell = rate.groupby([number, spell])
    lasting = by_spell.median().where(by_spell.size() >= _PACE_POINTS)
    fastest = lasting.groupby(level=0).max().fillna(rate.groupby(number).median())
    return np.asarray(fastest, dtype=np.float64)


def _speed_of_line(number: Integers, time: Floats, moving: Moving) -> Floats:
    """Return the speed of the straight line fitted to a track, m/s; 0 if residuals are large.

    This finds vehicles that cross the line of sight without Doppler; tracks that link several
    people do not fit a line.
    """
    count = np.bincount(number)
    centred = [
        values - (np.bincount(number, values) / count)[number]
        for values in (time, *moving.points.T[:2])
    ]
    t, east, north = centred
    spread = np.maximum(np.bincount(number, t**2), 1e-9)
    slopes = [np.bincount(number, t * coordinate) / spread for coordinate in (east, north)]
    speed = np.hypot(*slopes)
    residual = np.bincount(number, east**2 + north**2) / count - speed**2 * spread / count
    return np.where(np.sqrt(np.maximum(residual, 0.0)) < _ACROSS_M, speed, 0.0)


def top_speeds(moving: Moving, tracks: Integers) -> Floats:
    """Return the top speed of each track, m/s, over at least `_PACE_S`.

    Parameters
    ----------
    moving : Moving
        Moving detections of one window.
    tracks : (n,) array
        As from :func:`link_tracks`.
    """
    on_track = tracks != NONE
    linked = moving.where(on_track)
    return _top_speed(tracks[on_track], linked.time - moving.begin, linked)


def thin(moving: Moving, tracks: Integers, *, most: int = _MOST_SAMPLES) -> Samples:
    """Return up to `_PER_VOXEL` random detections of each track and voxel, at most `most` in all.

    Parameters
    ----------
    moving : Moving
        Moving detections of one window.
    tracks : (n,) array
        As from :func:`link_tracks`.
    most : int
        Most samples in all.
    """
    rng = np.random.default_rng(0)
    rows = np.flatnonzero(tracks != NONE)
    rows = rows[rng.permutation(len(rows))]
    cells = np.floor(moving.points[rows, :2] / _VOXEL_M).astype(np.int64)
    frame = pd.DataFrame({"k": tracks[rows], "i": cells[:, 0], "j": cells[:, 1]})
    keep = rows[(frame.groupby(["k", "i", "j"]).cumcount() < _PER_VOXEL).to_numpy()][:most]
    keep.sort()
    return Samples(
        points=moving.points[keep],
        range_rate=moving.range_rate[keep],
        track=tracks[keep],
        tracks=int(tracks.max(initial=NONE)) + 1,
        elevation=_elevation(moving.points),
        spell=_spells(moving.time[keep], tracks[keep]),
        vehicle=vehicles_of(moving, tracks),
    )


def vehicles_of(moving: Moving, tracks: Integers) -> Integers:
    """Return the vehicle of each track: one vehicle has several if it was hidden for a while.

    A track belongs to the vehicle of another one if it begins where that one is, or is predicted
    to be, with a similar range rate.

    Parameters
    ----------
    moving : Moving
        Moving detections of one window.
    tracks : (n,) array
        As from :func:`link_tracks`.

    Returns
    -------
    (tracks,) int64 array
        Number of the vehicle of each track, from 0.
    """
    rows = np.flatnonzero(tracks != NONE)
    rows = rows[np.argsort(tracks[rows], kind="stable")]
    first = np.unique(tracks[rows], return_index=True)[1]
    if len(first) == 0:
        return np.empty(0, dtype=np.int64)
    parent = _first_tracks(
        np.append(first, len(rows)), moving.time[rows], moving.points[rows, :2],
        moving.range_rate[rows],
    )  # fmt: skip
    return np.asarray(np.unique(parent, return_inverse=True)[1], dtype=np.int64)


@compiled
def _first_tracks(  # pragma: no cover - compiled
    first: Integers, time: Floats, points: Floats, rate: Floats
) -> Integers:
    """Return for each track the first track of its vehicle; rows are sorted by track, then time."""
    count = len(first) - 1
    parent = np.arange(count)
    for j in np.argsort(time[first[:-1]]):
        begin = time[first[j]]
        _, now, x, y, _, _, slow = straight_line(
            time, points, rate, first[j], first[j + 1], begin, begin + _PACE_S
        )
        best = _VEHICLE_M
        for i in range(count):
            ended = time[first[i + 1] - 1]
            if i == j or time[first[i]] > begin or ended < begin - _HIDDEN_S:
                continue
            # motion of track i around the begin of track j, or at its own end
            until = min(ended, begin + _PACE_S)
            known, then, a, b, east, north, pace = straight_line(
                time, points, rate, first[i], first[i + 1], until - 2.0 * _PACE_S, until
            )
            c, d = a + east * (now - then), b + north * (now - then)
            off = np.hypot(c - x, d - y) - _STRAY_MPS * max(begin - ended, 0.0)
            # predict the change of range rate by the changed line of sight
            pace += (east * c + north * d) / max(np.hypot(c, d), 1.0)
            pace -= (east * a + north * b) / max(np.hypot(a, b), 1.0)
            if known > 2.0 and off < best and abs(pace - slow) < _PACE_MPS:
                best = off
                parent[j] = parent[i]
    return parent


@compiled
def straight_line(  # pragma: no cover - compiled
    time: Floats, points: Floats, rate: Floats, low: int, high: int, since: float, until: float
) -> tuple[float, float, float, float, float, float, float]:
    """Fit a straight line to the rows low to high between two times.

    Returns the number of rows, their mean time and position (2), the velocity (2), and the mean
    range rate.
    """
    n, t, x, y, w, tt, tx, ty = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(low, high):
        if time[k] < since or time[k] > until:
            continue
        d = time[k] - since
        n, t, x, y, w = n + 1.0, t + d, x + points[k, 0], y + points[k, 1], w + rate[k]
        tt, tx, ty = tt + d * d, tx + d * points[k, 0], ty + d * points[k, 1]
    if n == 0.0:
        return 0.0, since, 0.0, 0.0, 0.0, 0.0, 0.0
    spread = max(tt - t * t / n, 1e-2)  # rows of a single moment give no velocity
    return (
        n,
        since + t / n,
        x / n,
        y / n,
        (tx - t * x / n) / spread,
        (ty - t * y / n) / spread,
        w / n,
    )


def _spells(time: Floats, track: Integers) -> Integers:
    """Return the number of each sample's spell in its track, from 0; `time` ascends."""
    first = np.full(int(track.max(initial=NONE)) + 1, np.inf)
    np.minimum.at(first, track, time)
    return np.asarray(np.floor((time - first[track]) / SPELL_S), dtype=np.int64)


def _elevation(points: Floats) -> float:
    """Return the 99.5 % quantile of absolute elevations, radians."""
    if len(points) == 0:
        return np.pi / 2
    x, y, z = points.T
    return float(np.percentile(np.abs(np.arctan2(z, np.hypot(x, y))), 99.5))


@compiled
def _track_roots(  # pragma: no cover - compiled
    time: Floats, reach: Floats, bearing: Floats, rate: Floats
) -> Integers:
    """Return the first detection of each one's track (union-find over pairs that agree)."""
    parent = np.arange(len(time))
    for i in range(len(time)):
        for j in range(i + 1, len(time)):
            lapse = time[j] - time[i]
            if lapse > _LINK_S:
                break
            moved = reach[j] - reach[i] - 0.5 * (rate[i] + rate[j]) * lapse
            if abs(rate[i] - rate[j]) > _MOST_RATE_CHANGE_MPS or abs(moved) > RANGE_M:
                continue
            turn = abs(bearing[j] - bearing[i])
            turn = min(turn, 2.0 * np.pi - turn)
            if turn * reach[i] > _ACROSS_M + _ACROSS_MPS * lapse:
                continue
            a, b = i, j
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            parent[max(a, b)] = min(a, b)
    for i in range(len(parent)):  # parents have lower numbers
        parent[i] = parent[parent[i]]
    return parent
