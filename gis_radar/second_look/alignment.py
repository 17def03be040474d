"""Score how well what stands in a recording fits a scan, here and at poses moved and turned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import fft, ndimage

from gis_radar.arrays import Booleans, Floats
from gis_radar.grid import CELL_M
from gis_radar.second_look.settings import DEFAULTS, SecondLookSettings
from gis_radar.second_look.standing import Standing
from gis_radar.second_look.structure import Structure


@dataclass(frozen=True, kw_only=True)
class PoseOffset:
    """A pose beside the answer, and how well it fits.

    Parameters
    ----------
    ahead_m, left_m : float
        How far it is moved, as the sensor looks.
    turn_deg : float
        How far it is turned about the sensor, counter-clockwise, -180 to 180.
    score : float
        0 to 1; see :class:`Alignment`.
    """

    ahead_m: float
    left_m: float
    turn_deg: float
    score: float

    @property
    def place(self) -> tuple[float, float, float]:
        """Metres ahead and left, and degrees."""
        return self.ahead_m, self.left_m, self.turn_deg

    @property
    def shift_m(self) -> float:
        """How far it is moved."""
        return float(np.hypot(self.ahead_m, self.left_m))

    def words(self) -> str:
        """Return shift and turn as text."""
        return f"{self.shift_m:.1f} m and {abs(self.turn_deg):.1f} deg away"

    def beyond(self, shift_m: float, turn_deg: float) -> bool:
        """Return whether it is moved or turned so far."""
        return self.shift_m >= shift_m or abs(self.turn_deg) >= turn_deg


HERE = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """What stands, compared with a scan.

    The score of a pose is the mean over the standing cells of `exp(-d^2 / 2 close_m^2)`, `d` their
    distance to the next structure of the scan: the share that is where it should be.

    Parameters
    ----------
    standing : Standing
        The cells, in the level frame of the answer.
    closeness : (n, n) array
        That value for each cell of the frame.
    settings : SecondLookSettings
        Reach and steps of the search.
    """

    standing: Standing = field(repr=False)
    closeness: Floats = field(repr=False)
    settings: SecondLookSettings = field(default=DEFAULTS, repr=False)

    def at(self, offset: Sequence[float]) -> Floats:
        """Return the closeness of each standing cell at (ahead, left, turn in degrees)."""
        ahead, left, turn = offset
        angle = np.radians(turn)
        cos, sin = np.cos(angle), np.sin(angle)
        x, y = self.standing.points[:, :2].T
        place = np.array([cos * x - sin * y + ahead, sin * x + cos * y + left]) / CELL_M
        return np.asarray(
            ndimage.map_coordinates(
                self.closeness, place + (len(self.closeness) // 2 - 0.5), order=1, mode="constant"
            )
        )

    def score(self, offset: Sequence[float] = HERE) -> float:
        """Return the score at (ahead, left, turn in degrees)."""
        return float(self.at(offset).mean())

    def offset(self, place: Sequence[float]) -> PoseOffset:
        """Return an offset with its score."""
        ahead, left, turn = (float(value) for value in place)
        turn = (turn + 180.0) % 360.0 - 180.0
        return PoseOffset(ahead_m=ahead, left_m=left, turn_deg=turn, score=self.score(place))

    @property
    def here(self) -> PoseOffset:
        """The answer itself."""
        return self.offset(HERE)

    def lead(self, one: PoseOffset, other: PoseOffset) -> float:
        """Return by how many standard deviations what stands prefers one offset to another.

        Neighbouring cells show one wall or one tree, so they vote in patches.
        """
        return self._vote(self.at(one.place) - self.at(other.place))

    def over(self, chance: float) -> float:
        """Return by how many standard deviations the answer's score is over another one."""
        return self._vote(self.at(HERE) - chance)

    def _vote(self, gain: Floats) -> float:
        votes = np.bincount(self.standing.patch, gain)
        spread = float(np.sqrt((votes**2).sum()))
        return float(votes.sum()) / spread if spread > 0.0 else 0.0

    def climbed(self, place: Sequence[float], *, apart: bool = False) -> PoseOffset:
        """Climb from an offset to the top nearby; with `apart`, stay away from the answer."""
        best = self.offset(place)
        lane_m, askew_deg = self.settings.lane_m, self.settings.askew_deg
        farthest_m = self.settings.shift_m * np.sqrt(2.0)
        for shift_m, turn_deg in self.settings.steps:
            step = np.array([shift_m, shift_m, turn_deg])
            for _ in range(30):
                around = [self.offset(best.place + move * step) for move in _MOVES]
                around = [o for o in around if o.shift_m <= farthest_m]
                if apart:
                    around = [o for o in around if o.beyond(lane_m, askew_deg)]
                top = max(around, key=lambda o: o.score, default=best)
                if top.score <= best.score + 1e-9:
                    break
                best = top
        return best

    def surface(self) -> Floats:
        """Return the scores at the answer's heading, (ahead, left) every cell up to `shift_m`."""
        return _shifted(_Search(self, 1), 0.0)

    def explored(self) -> tuple[list[PoseOffset], float]:
        """Return the best offsets far from each other in all headings, and the mean of all."""
        search = _Search(self, self.settings.coarse)
        turns = np.arange(-180.0, 180.0, self.settings.turn_deg)
        scores = np.stack([_shifted(search, turn) for turn in turns])
        size = (7, 5, 5)
        peak = ndimage.maximum_filter(scores, size, mode=("wrap", "nearest", "nearest")) == scores
        order = np.argsort(-np.where(peak, scores, -1.0), axis=None)[: self.settings.candidates]
        tops = np.column_stack(np.unravel_index(order, scores.shape))
        middle = scores.shape[1] // 2
        places = [
            ((i - middle) * search.cell_m, (j - middle) * search.cell_m, turns[k])
            for k, i, j in tops.tolist()
        ]
        return [self.offset(place) for place in places], float(scores.mean())


_MOVES = np.array(
    [(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1) if a or b or c], float
)


def align(
    standing: Standing, structure: Structure, settings: SecondLookSettings = DEFAULTS
) -> Alignment:
    """Compare what stands with a scan."""
    closeness = _closeness(structure.visible, settings.close_m)
    return Alignment(standing=standing, closeness=closeness, settings=settings)


def _closeness(cells: Booleans, slack_m: float) -> Floats:
    if not cells.any():
        return np.zeros(cells.shape)
    away = ndimage.distance_transform_edt(~cells) * CELL_M
    return np.asarray(np.exp(-0.5 * (away / slack_m) ** 2))


class _Search:
    """Scores of all shifts at once, by convolution."""

    def __init__(self, alignment: Alignment, coarse: int) -> None:
        field = alignment.closeness
        if coarse > 1:
            field = ndimage.gaussian_filter(
                field, coarse * alignment.settings.close_m / CELL_M / 2.0
            )
        size = len(field) // coarse
        field = field[: size * coarse, : size * coarse]
        field = field.reshape(size, coarse, size, coarse).mean(axis=(1, 3))
        self.size = int(fft.next_fast_len(size, real=True))
        self.middle = size / 2.0
        self.cell_m = CELL_M * coarse
        self.most = round(alignment.settings.shift_m / self.cell_m)
        self.points = alignment.standing.points[:, :2]
        self.spectrum = fft.rfft2(field.astype(np.float32), (self.size, self.size))


def _shifted(search: _Search, turn_deg: float) -> Floats:
    angle = np.radians(turn_deg)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    place = np.floor(search.points @ turn / search.cell_m + search.middle).astype(np.int64)
    cell = place[:, 0] * search.size + place[:, 1]
    count = np.bincount(cell, minlength=search.size**2).astype(np.float32)
    image = fft.rfft2(count.reshape(search.size, search.size))
    scores = fft.irfft2(search.spectrum * np.conj(image), (search.size, search.size))
    reach = np.arange(-search.most, search.most + 1)
    return np.asarray(scores[np.ix_(reach, reach)], np.float64) / len(search.points)
