"""Extract traces of moving vehicles from a window: link detections to tracks, thin to samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from gis_radar.base import Booleans, Floats, Integers, compiled

FRAMES = 2000  # of the window, 100 s at 20 Hz (the paper's n_f)
LEAST_FRAMES = 100  # fewer are refused: 5 s show no traffic
MIN_SPEED_MPS = 0.15  # least absolute range rate of what moves (the paper)
SEGMENT_S = 8.0  # a stream of vehicles that never breaks counts as several tracks of this length
WALK_MPS = 2.7  # slower tracks, by range rates and by way, may be of walkers and their limbs
MOST_SAMPLES = 6000  # most samples in all; cost grows in proportion
LINK_S = 0.35  # longest gap in a track: a far vehicle is hit in every fourth frame or so
RANGE_M = 1.5  # largest disagreement of range and Doppler: between the faces of one vehicle
# Largest step across the sight: a vehicle's size, and a crossing speed that the Doppler misses.
ACROSS_M = 1.5
ACROSS_MPS = 6.0
RATE_MPS = 1.5  # largest difference of range rates in a track: a vehicle that turns
# A track of fewer points is a false alarm, a slow track with a shorter path is a leaf.
MIN_POINTS = 6
MIN_PATH_M = 3.0
SURE_MPS = 1.5  # leaves have a lower median range rate
# Share of all tracks from which on those no faster than walkers are left out: up to 0.11 in a
# gridlock, 0.2 and more with 48 walkers in view; the fit takes a share as small for strays.
CREEPING = 0.15
# Voxels wider than a vehicle, and samples kept of a track in each: enough to keep the proportion
# of its faces.
VOXEL_M = 6.0
PER_VOXEL = 8
CROWD_M = 10.0  # length over which the samples of a vehicle share its swaying (`Model.wander`)
# A track that begins where a hidden vehicle would be by then, within the vehicle's length and a
# growing error, is of that vehicle.
HIDDEN_S = 6.0
VEHICLE_M = 5.0
STRAY_MPS = 1.0
# Time over which begin and motion of a track are taken, and largest difference of range rates of
# one vehicle's tracks: more than RATE_MPS, as it may turn while it is hidden.
PACE_S = 0.5
PACE_MPS = 3.0
PACE_POINTS = 4  # least detections in PACE_S: the median of three may be a limb
# Length of a spell, in which samples of a vehicle share an error of elevation (`Model.bent`): much
# shorter than the time in which that changes.
SPELL_S = 1.0


NONE = -1  # track number of detections on no track


@dataclass(frozen=True, kw_only=True)
class Moving:
    """The moving detections of a window.

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
        UNIX seconds of its first and last frame.
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
        """Return some of the detections, of the same window."""
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
        Half of the vertical opening of the view, radians: hardly any detection exceeds it.
    spell : (n,) array, optional
        Number of each sample's spell of `SPELL_S` in its track, from 0; by default all in one.
    vehicle : (tracks,) array, optional
        Number of the vehicle of each track, from 0; by default each track is one.
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
        """Number of samples of the same track within the same `CROWD_M`, itself included."""
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
        """Indices of the samples, track by track and each in time, as samples are by time."""
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
        """Elevation angles of the samples, radians."""
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


def link_tracks(moving: Moving, *, segment_s: float = SEGMENT_S) -> Integers:
    """Link moving detections to tracks.

    Two detections belong together where the range changed as the Doppler states and bearing and
    Doppler are alike. Tracks of few points are false alarms; slow ones that go nowhere are leaves;
    where many are no faster than walkers, these are left out.

    Parameters
    ----------
    moving : Moving
        Of one window.
    segment_s : float
        Longer tracks are cut, seconds.

    Returns
    -------
    (n,) int64 array
        Number of the track, `NONE` for detections of none.
    """
    if len(moving) == 0:
        return np.empty(0, dtype=np.int64)
    time = moving.time - moving.time[0]
    x, y = moving.points[:, 0], moving.points[:, 1]
    reach = np.linalg.norm(moving.points, axis=1)
    root = _link(time, reach, np.arctan2(y, x), moving.range_rate)
    table = pd.DataFrame({"root": root, "segment": (time / segment_s).astype(np.int64)})
    number = np.asarray(table.groupby(["root", "segment"], sort=True).ngroup(), dtype=np.int64)
    good = _goes_somewhere(number, time, moving)
    renumbered = np.where(good, np.cumsum(good) - 1, NONE)
    return np.asarray(renumbered[number])


def _goes_somewhere(number: Integers, time: Floats, moving: Moving) -> Booleans:
    """Return which tracks are long and fast enough for something that drives."""
    x, y, _ = moving.points.T
    columns = {"n": number, "x": x, "y": y, "rate": np.abs(moving.range_rate)}
    rows = pd.DataFrame(columns).groupby("n")
    early, late = rows.head(2).groupby("n").mean(), rows.tail(2).groupby("n").mean()
    path = np.hypot(late["x"] - early["x"], late["y"] - early["y"])
    extent = np.hypot(rows["x"].max() - rows["x"].min(), rows["y"].max() - rows["y"].min())
    goes = (path >= MIN_PATH_M) & (path >= 0.5 * extent)
    streams = (rows["rate"].median() >= SURE_MPS) & (extent >= MIN_PATH_M)
    good = (rows.size() >= MIN_POINTS) & (goes | streams)
    drives = good & (_fastest(number, time, moving) > WALK_MPS)
    # walkers keep off the lanes, but in a queue vehicles are as slow
    walkers = 1.0 - drives.sum() / max(good.sum(), 1)
    return np.asarray(drives if walkers > CREEPING else good)


def _fastest(number: Integers, time: Floats, moving: Moving) -> Floats:
    """Return the highest lasting speed of each track, m/s."""
    return np.maximum(_pace(number, time, moving), _steady_speed(number, time, moving))


def _pace(number: Integers, time: Floats, moving: Moving) -> Floats:
    """Return the highest lasting range rate of each track, m/s: a median over `PACE_S`.

    A walker's limbs swing at up to two and a half times the walking speed, the trunk does not.
    """
    rate = pd.Series(np.abs(moving.range_rate))
    spell = np.floor(time / PACE_S).astype(np.int64)
    by_spell = rate.groupby([number, spell])
    lasting = by_spell.median().where(by_spell.size() >= PACE_POINTS)
    fastest = lasting.groupby(level=0).max().fillna(rate.groupby(number).median())
    return np.asarray(fastest, dtype=np.float64)


def _steady_speed(number: Integers, time: Floats, moving: Moving) -> Floats:
    """Return the speed of the straight line that fits a track, m/s; 0 where none does.

    Objects that cross the sight have no Doppler; people behind each other form no line.
    """
    count = np.bincount(number)
    centred = [v - (np.bincount(number, v) / count)[number] for v in (time, *moving.points.T[:2])]
    t, east, north = centred
    spread = np.maximum(np.bincount(number, t**2), 1e-9)
    slopes = [np.bincount(number, t * way) / spread for way in (east, north)]
    speed = np.hypot(*slopes)
    left = np.bincount(number, east**2 + north**2) / count - speed**2 * spread / count
    return np.where(np.sqrt(np.maximum(left, 0.0)) < ACROSS_M, speed, 0.0)


def top_speeds(moving: Moving, tracks: Integers) -> Floats:
    """Return the highest lasting speed of each track, m/s.

    Parameters
    ----------
    moving : Moving
        Of one window.
    tracks : (n,) array
        As from :func:`link_tracks`.
    """
    on = tracks != NONE
    followed = moving.where(on)
    return _fastest(tracks[on], followed.time - moving.begin, followed)


def thin(moving: Moving, tracks: Integers, *, most: int = MOST_SAMPLES) -> Samples:
    """Keep a few detections of each track in each voxel, thinned evenly to a limit.

    Parameters
    ----------
    moving : Moving
        Of one window.
    tracks : (n,) array
        As from :func:`link_tracks`.
    most : int
        Most samples in all.
    """
    rng = np.random.default_rng(0)
    on = np.flatnonzero(tracks != NONE)
    on = on[rng.permutation(len(on))]
    cells = np.floor(moving.points[on, :2] / VOXEL_M).astype(np.int64)
    frame = pd.DataFrame({"k": tracks[on], "i": cells[:, 0], "j": cells[:, 1]})
    keep = on[(frame.groupby(["k", "i", "j"]).cumcount() < PER_VOXEL).to_numpy()][:most]
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
    """Return which tracks are of one vehicle that was hidden for a while, or whose faces differ.

    A track that begins where another one is at that time, or would be by then, with the same range
    rate, is of the same vehicle.

    Parameters
    ----------
    moving : Moving
        Of one window.
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
    parent = _join(
        np.append(first, len(rows)), moving.time[rows], moving.points[rows, :2],
        moving.range_rate[rows],
    )  # fmt: skip
    return np.asarray(np.unique(parent, return_inverse=True)[1], dtype=np.int64)


@compiled
def _join(  # pragma: no cover - compiled
    first: Integers, time: Floats, points: Floats, rate: Floats
) -> Integers:
    """Return for each track the first track of its vehicle; rows are sorted by track, then time."""
    count = len(first) - 1
    parent = np.arange(count)
    for j in np.argsort(time[first[:-1]]):
        begin = time[first[j]]
        _, now, x, y, _, _, slow = straight_line(
            time, points, rate, first[j], first[j + 1], begin, begin + PACE_S
        )
        best = VEHICLE_M
        for i in range(count):
            ended = time[first[i + 1] - 1]
            if i == j or time[first[i]] > begin or ended < begin - HIDDEN_S:
                continue
            # motion of the other track around that time, or at its end
            until = min(ended, begin + PACE_S)
            known, then, a, b, east, north, pace = straight_line(
                time, points, rate, first[i], first[i + 1], until - 2.0 * PACE_S, until
            )
            c, d = a + east * (now - then), b + north * (now - then)
            off = np.hypot(c - x, d - y) - STRAY_MPS * max(begin - ended, 0.0)
            # as it passes the sensor its range rate changes
            pace += (east * c + north * d) / max(np.hypot(c, d), 1.0)
            pace -= (east * a + north * b) / max(np.hypot(a, b), 1.0)
            if known > 2.0 and off < best and abs(pace - slow) < PACE_MPS:
                best = off
                parent[j] = parent[i]
    return parent


@compiled
def straight_line(  # pragma: no cover - compiled
    time: Floats, points: Floats, rate: Floats, low: int, high: int, since: float, until: float
) -> tuple[float, float, float, float, float, float, float]:
    """Fit a straight line to the rows between two times.

    Returns the number of rows, their mean time and place, the velocity, and the mean range rate.
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
    if len(points) == 0:
        return np.pi / 2
    x, y, z = points.T
    return float(np.percentile(np.abs(np.arctan2(z, np.hypot(x, y))), 99.5))


@compiled
def _link(  # pragma: no cover - compiled
    time: Floats, reach: Floats, bearing: Floats, rate: Floats
) -> Integers:
    """Return the root of each detection's track (union-find over pairs that agree)."""
    parent = np.arange(len(time))
    for i in range(len(time)):
        for j in range(i + 1, len(time)):
            lapse = time[j] - time[i]
            if lapse > LINK_S:
                break
            moved = reach[j] - reach[i] - 0.5 * (rate[i] + rate[j]) * lapse
            if abs(rate[i] - rate[j]) > RATE_MPS or abs(moved) > RANGE_M:
                continue
            turn = abs(bearing[j] - bearing[i])
            turn = min(turn, 2.0 * np.pi - turn)
            if turn * reach[i] > ACROSS_M + ACROSS_MPS * lapse:
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
