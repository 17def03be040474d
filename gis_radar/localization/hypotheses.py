"""Hypotheses: starts from the search, fitted one by one, compared vehicle by vehicle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.arrays import Floats
from gis_radar.localization.adaptation import adapted
from gis_radar.localization.certainty import advantage, along_valley
from gis_radar.localization.lanes import CELL_M, Lanes
from gis_radar.localization.model import MODEL, Model
from gis_radar.localization.search import TILT, Candidate, Levelling, level, search
from gis_radar.localization.solver import Fit, Prior, solve
from gis_radar.localization.state import POSE, REFLECTION, SIZE, State
from gis_radar.localization.traces import Samples

REFLECTION_M, REFLECTION_SIGMA_M = 0.6, 0.25  # between wheel hubs and belt lines
GUESS_M = 15.0  # how far a guess may be off
SLACK_M = 2.0
CANDIDATES, KNOWN_CANDIDATES = 20, 8  # without and with a heading
FINALISTS, GONE = 4, 5.0  # most of them; standard deviations behind the first
RIVAL = 3.5  # behind the first; a closer look brings a place nearer by about half of one
ROUGH_SAMPLES = 1000
ROUGH_SCALES_M, FINE_SCALES_M = (1.5, 0.75, 0.3), (0.2, 0.1, 0.0)
ROUGH_ROUNDS, FINE_ROUNDS = 4, 30
TWIN = np.array([0.3, 0.3, 0.5, *np.radians([0.5, 0.5, 0.3])])
LANE_M = 3.5
CLIMBS, HOP_M, HOP_SCALES_M = 5, 0.7, (0.3, 0.1, 0.0)
PLANE, LEVER = [0, 1, 5], np.diag([1.0, 1.0, 60.0])  # a turn moves what is 60 m away


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """One way to lay the recording on the map.

    Parameters
    ----------
    fit : Fit
        The local optimum.
    prior : Prior
        With which it was found.
    origin : str
        `search` or `shifted`, by a lane.
    model : Model
        How vehicles drive and reflect.
    """

    fit: Fit
    prior: Prior
    origin: str
    model: Model = MODEL

    @property
    def loss(self) -> float:
        """Mean loss of the samples."""
        return float(self.fit.loss.mean())


def explore(
    lanes: Lanes, samples: Samples, *, heading: tuple[float, float] | None
) -> list[Hypothesis]:
    """Return hypotheses that differ, the best first, fitted to a part of the samples.

    Parameters
    ----------
    lanes, samples : Lanes, Samples
        The map around the guess, and the traces.
    heading : (yaw, tolerance) or None
        Radians; without it all headings are tried.
    """
    levelling, part = level(samples), rough(samples)
    most = CANDIDATES if heading is None else KNOWN_CANDIDATES
    found = _searched(lanes, samples, levelling, heading, most)
    tried = [_rough_fit(lanes, part, _start(lanes, part, levelling, c), "search") for c in found]
    best = min(tried, key=lambda h: h.loss)
    tried += [_rough_fit(lanes, part, state, "shifted") for state in shifted(lanes, best.fit)]
    return _ranked(tried)


def promise(lanes: Lanes, samples: Samples, *, heading: tuple[float, float] | None) -> float:
    """Return how well the search alone can lay samples on the lanes, 0 to 1.

    Parameters
    ----------
    lanes, samples, heading
        As for :func:`explore`.
    """
    return _searched(lanes, samples, level(samples), heading, 1)[0].score


def _searched(
    lanes: Lanes,
    samples: Samples,
    levelling: Levelling,
    heading: tuple[float, float] | None,
    most: int,
) -> list[Candidate]:
    levelled = samples.points @ levelling.R_level_sensor.T
    return search(lanes, samples, levelled, radius_m=GUESS_M + SLACK_M, heading=heading, most=most)


def rough(samples: Samples) -> Samples:
    """Return an even part of the samples, enough to tell hypotheses apart."""
    chosen = np.random.default_rng(1).permutation(len(samples))[:ROUGH_SAMPLES]
    return samples.where(np.isin(np.arange(len(samples)), chosen))


def climb(lanes: Lanes, samples: Samples, best: Hypothesis) -> Hypothesis:
    """Look beside an optimum for better ones, along the directions that are fixed least.

    Which face of which vehicle a trace shows makes the cost bumpy in the small.
    """
    for _ in range(CLIMBS):
        covariance = np.linalg.inv(best.fit.information[POSE, POSE])[np.ix_(PLANE, PLANE)]
        _, vectors = np.linalg.eigh(LEVER @ covariance @ LEVER)
        sides = np.zeros((4, SIZE))
        sides[:, PLANE] = HOP_M * np.vstack([vectors.T[1:], -vectors.T[1:]]) @ np.linalg.inv(LEVER)
        others = [_settled(lanes, samples, best, best.fit.state.moved(side)) for side in sides]
        better = min(others, key=lambda other: other.fit.cost)
        if better.fit.cost > best.fit.cost - 1.0:
            break
        best = better
    return best


def _settled(lanes: Lanes, samples: Samples, hypothesis: Hypothesis, start: State) -> Hypothesis:
    fit = solve(lanes, samples, start, hypothesis.prior, scales_m=HOP_SCALES_M, rounds=ROUGH_ROUNDS)
    return replace(hypothesis, fit=fit)


def refine(lanes: Lanes, samples: Samples, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Fit the first hypotheses to all samples, and return them the best first.

    The best one is looked at in full, and so is each that could still overtake it.
    """
    part, best = rough(samples), hypotheses[0]
    finalists = [h for h in hypotheses if advantage(best.fit, h.fit, part) < GONE][:FINALISTS]
    settled = _ranked([_settled(lanes, part, h, h.fit.state) for h in finalists])
    climbed = _with_rivals(settled, part, partial(climb, lanes, part))
    fine = _ranked([_fine(lanes, samples, h) for h in climbed])
    return _with_rivals(fine, samples, partial(_adapted, lanes, samples))


def _with_rivals(
    ranked: Sequence[Hypothesis], samples: Samples, better: Callable[[Hypothesis], Hypothesis]
) -> list[Hypothesis]:
    """Improve the best hypothesis and its rivals, and return all, the best first."""
    first = ranked[0]
    near = [advantage(first.fit, h.fit, samples) < RIVAL for h in ranked]
    return _ranked([better(h) if close else h for h, close in zip(ranked, near, strict=True)])


def _fine(lanes: Lanes, samples: Samples, hypothesis: Hypothesis) -> Hypothesis:
    fit = solve(
        lanes,
        samples,
        hypothesis.fit.state,
        hypothesis.prior,
        scales_m=FINE_SCALES_M,
        rounds=FINE_ROUNDS,
        model=hypothesis.model,
    )
    return replace(hypothesis, fit=fit)


def _adapted(lanes: Lanes, samples: Samples, fine: Hypothesis) -> Hypothesis:
    """Fit to all samples, with what these tell about the radar and the vehicles."""
    prior, model = adapted(lanes, samples, fine.fit, fine.prior, fine.model)
    return _fine(lanes, samples, replace(fine, model=model, prior=prior))


def surveyed(lanes: Lanes, samples: Samples, hypothesis: Hypothesis) -> Hypothesis:
    """Return a hypothesis that knows no more than what lies along its weakest way tells."""
    h = hypothesis
    return replace(h, fit=along_valley(lanes, samples, h.fit, h.prior, h.model))


def _start(lanes: Lanes, samples: Samples, levelling: Levelling, candidate: Candidate) -> State:
    """Return the state at a candidate, at the height that puts the traces over the road."""
    turn = Rotation.from_euler("Z", candidate.yaw).as_matrix()
    state = State(
        position=np.array([*candidate.place, 0.0]),
        R_map_sensor=turn @ levelling.R_level_sensor,
        reflection=REFLECTION_M,
    )
    points = state.to_map(samples.points)
    cell = np.floor((points[:, :2] - lanes.corner) / CELL_M).astype(np.int64)
    _, rows, columns = lanes.distance.shape
    inside = (cell >= 0).all(axis=1) & (cell < [columns, rows]).all(axis=1)
    column, row = cell[inside].T
    nearest = np.argmin(lanes.distance[:, row, column], axis=0)
    lane = lanes.nearest[nearest, row, column]
    over = lanes.points[lane, 2] + REFLECTION_M - points[inside, 2]
    over = over[(lane >= 0) & np.isfinite(over)]
    known = lanes.points[:, 2][np.isfinite(lanes.points[:, 2])]
    height = np.median(over) if len(over) else np.median(known) + levelling.depth_m
    return replace(state, position=np.array([*candidate.place, float(height)]))


def prior_at(state: State) -> Prior:
    """Return what is known before looking: about where the guess is, a mast that hardly leans.

    Parameters
    ----------
    state : State
        A start; its tilt is the levelled one, the guess is the local (0, 0).
    """
    information = np.zeros((SIZE, SIZE))
    sigma = np.array([GUESS_M / 2, GUESS_M / 2, GUESS_M, TILT, TILT, np.pi])
    information[POSE, POSE] = np.diag(sigma**-2)
    information[REFLECTION, REFLECTION] = REFLECTION_SIGMA_M**-2
    mean = replace(state, position=np.array([0.0, 0.0, state.position[2]]))
    return Prior(mean=mean, information=information)


def _rough_fit(lanes: Lanes, samples: Samples, start: State, origin: str) -> Hypothesis:
    prior = prior_at(start)
    fit = solve(lanes, samples, start, prior, scales_m=ROUGH_SCALES_M, rounds=ROUGH_ROUNDS)
    return Hypothesis(fit=fit, prior=prior, origin=origin)


def shifted(lanes: Lanes, fit: Fit) -> list[State]:
    """Return the fit's state moved by a lane to every side of the main directions of traffic."""
    used = lanes.along[fit.matches.lane[fit.matches.found]]
    if len(used) == 0:
        return []
    # twice the angle: both directions of a street are one
    turn = np.arctan2(used[:, 1], used[:, 0])
    main = np.angle(np.mean(np.exp(2j * turn))) / 2.0
    width = float(np.median(lanes.width_m[fit.matches.lane[fit.matches.found]]))
    width = width if 2.0 < width < 5.0 else LANE_M
    sides = main + np.arange(4) * np.pi / 2.0
    moves = width * np.column_stack([np.cos(sides), np.sin(sides), np.zeros(4)])
    return [replace(fit.state, position=fit.state.position + move) for move in moves]


def _ranked(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses the best first, without what another, better one has found as well."""
    kept: list[Hypothesis] = []
    for h in sorted(hypotheses, key=lambda h: h.loss):
        gaps = [np.abs(h.fit.state.difference(k.fit.state)[POSE]) / TWIN for k in kept]
        if not any((gap < 1.0).all() for gap in gaps):
            kept.append(h)
    return kept


def mirrored(samples: Samples) -> Samples:
    """Return the samples of a sensor whose y axis points to the other side."""
    points: Floats = samples.points * [1.0, -1.0, 1.0]
    return replace(samples, points=points)
