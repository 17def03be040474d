"""Localize by the method `lane`: registration of tracks to lanes and to the scanned road."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gis_radar.base import InputError, NoAnswerError, Reporter, Text
from gis_radar.calibration.registration.certainty import CLEAR, PLANE, advantage, certainty, stated
from gis_radar.calibration.registration.hypotheses import (
    GUESS_M,
    HEADING_TOLERANCE,
    Hypothesis,
    find_hypotheses,
    mirrored,
    refine,
    rough,
    search_score,
    widen_by_profile,
)
from gis_radar.calibration.registration.lanes import MARGIN_M, Lanes, Scene, sample_lanes
from gis_radar.calibration.registration.state import POSE_PART, from_arc
from gis_radar.calibration.registration.traces import Moving, Samples, link_tracks, thin
from gis_radar.calibration.single.result import STAGE, AmbiguousError, Localization, Problem, common

LEAST_TRACKS = 5  # fewer vehicles do not fix the seven components of the state
# Least share of samples on lanes: right poses have 0.8 to 0.99, poses a lane off 0.6 to 0.8.
LEAST_FITNESS = 0.6
# Largest chi-square of the difference of equivalent poses (99.9 %, 3 components).
_SAME_CHI2 = 16.0
# Optima nearer to each other are one answer with a larger sigma: lanes are farther apart, and
# offsets of drivers from the middle of their lanes split an optimum by as much.
_ONE_ANSWER_M = 1.0
_ONE_ANSWER_RAD = math.radians(3.0)
_LEAST_SCANNED = 0.3  # least share of lane samples in reach with a height of the scanned road
_ANSWER_SLACK_M = 5.0  # an accepted pose is within GUESS_M and this of the guess


def by_lanes(problem: Problem, moving: Moving, reporter: Reporter) -> Localization:
    """Localize by registration of tracks to lanes that agree with their Doppler."""
    samples = thin(moving, link_tracks(moving))
    if samples.tracks < LEAST_TRACKS:
        raise NoAnswerError(
            "{}: {} moving vehicles in {} frames, at least {} are needed",
            problem.name,
            samples.tracks,
            moving.frames,
            LEAST_TRACKS,
            hint="record while traffic flows",
        )
    reporter.progress(STAGE, 1, 5)
    scene = Scene(lanes=lanes_around(problem, samples, reporter), samples=samples)
    heading = None if problem.heading is None else (problem.heading, HEADING_TOLERANCE)
    hypotheses = find_hypotheses(scene, heading=heading)
    reporter.progress(STAGE, 3, 5)
    _refuse_mirrored(scene, hypotheses, heading)
    reporter.progress(STAGE, 4, 5)
    first, *others = refine(scene, hypotheses)
    # a fit that slid beyond reach along an open direction is moved back by the profile
    first = widen_by_profile(scene, first)
    best, *others = _within_reach(problem, [first, *others], scene)
    best = best if best is first else widen_by_profile(scene, best)
    _refuse_unfit(problem, best)
    twins = [h for h in others if _is_same_answer(best, h)]
    rivals = [h for h in others if not any(h is twin for twin in twins)]
    z_score, rival = _least_z_score(best, rivals, scene)
    reporter.progress(STAGE, 5, 5)
    if rival is not None and z_score < CLEAR:
        likely = _distinct([best, *_not_ruled_out(best, others, scene)])
        answers = [_localization(problem, moving, scene, h, hypotheses, z_score) for h in likely]
        raise _ambiguous_error(problem, best, rival, tuple(answers))
    twin_z_score, twin = _least_z_score(best, twins, scene)
    if twin is not None and twin_z_score < CLEAR:
        best = replace(best, rival=twin.fit.state)
    return _localization(problem, moving, scene, best, hypotheses, z_score)


def lanes_around(
    problem: Problem,
    samples: Samples,
    reporter: Reporter,
    *,
    grow: float = 1.0,
) -> Lanes:
    """Return the lanes around the guess within the range of the samples.

    Parameters
    ----------
    problem : Problem
        Map, road and guess.
    samples : Samples
        Traces.
    reporter : Reporter
        Receives a warning where most lanes are two-way.
    grow : float
        Factor on the range of the samples.

    Raises
    ------
    InputError
        If lanes and scanned road do not overlap.
    NoAnswerError
        If no lane is there.
    """
    reach = np.hypot(samples.points[:, 0], samples.points[:, 1])
    reach_m = grow * float(np.percentile(reach, 99.5))
    lanes = sample_lanes(
        problem.roads.lanelets,
        problem.road,
        place=problem.guess[:2],
        reach_m=reach_m + GUESS_M + MARGIN_M,
    )
    if lanes.scanned < _LEAST_SCANNED:
        raise InputError(
            "the road's points lie on {:.0%} of the lanes around the guess",
            lanes.scanned,
            hint="take the mask of a scan of this place, in the map's coordinate system",
        )
    if not lanes.directed:
        reporter.warn("most lanes have no direction: the sign of the Doppler does not help")
    return lanes


def _refuse_mirrored(
    scene: Scene, tried: list[Hypothesis], heading: tuple[float, float] | None
) -> None:
    """Refuse a recording that fits far better with left and right swapped."""
    mirrored_scene, best = scene.of(mirrored(scene.samples)), tried[0]
    if search_score(mirrored_scene, heading=heading) < max(h.score for h in tried):
        return
    mirrored_best = find_hypotheses(mirrored_scene, heading=heading)[0]
    z_score = advantage(mirrored_best.fit, best.fit, rough(scene).samples)
    if z_score > CLEAR and mirrored_best.fit.fitness > LEAST_FITNESS:
        raise NoAnswerError(
            "the recording fits the lanes only when mirrored ({:.0%} of the traces, "
            "{:.0%} as it is)",
            mirrored_best.fit.fitness,
            best.fit.fitness,
            hint="the y axis of the sensor frame must point to the left; change the sign of y",
        )


def _least_z_score(
    answer: Hypothesis, others: list[Hypothesis], scene: Scene
) -> tuple[float, Hypothesis | None]:
    """Return the least z score of an answer over other hypotheses, and the hypothesis of it."""
    best, known = answer.fit, certainty(answer.fit)
    z_score, rival = math.inf, None
    for other in others:
        away_m = float(np.hypot(*other.fit.state.position[:2]))
        if away_m > GUESS_M or other.fit.fitness < LEAST_FITNESS:
            continue  # would not be accepted as an answer
        x, y, *_, turn = other.fit.state.difference(best.state)[POSE_PART]
        gap = np.array([*from_arc(x, y, turn), turn])
        # poses that differ along a direction of large sigma only, as in a bend, are equivalent
        chi2 = gap @ np.linalg.solve(known.covariance[np.ix_(PLANE, PLANE)], gap)
        z_score_over = advantage(best, other.fit, scene.samples)
        if chi2 > _SAME_CHI2 and z_score_over < z_score:
            z_score, rival = z_score_over, other
    return z_score, rival


def _within_reach(problem: Problem, answers: list[Hypothesis], scene: Scene) -> list[Hypothesis]:
    """Return the hypotheses near the guess; refuse where one farther off is clearly better."""
    distances_m = [float(np.hypot(*h.fit.state.position[:2])) for h in answers]
    farthest_m = GUESS_M + _ANSWER_SLACK_M
    inside = [h for h, away_m in zip(answers, distances_m, strict=True) if away_m < farthest_m]
    if not inside or (
        inside[0] is not answers[0]
        and advantage(answers[0].fit, inside[0].fit, scene.samples) > CLEAR
    ):
        raise NoAnswerError(
            "{}: the fit went {:.0f} m from the guess, which is too far off",
            problem.name,
            distances_m[0],
            hint=_after_heading(problem, Text("guess within {:.0f} m", GUESS_M)),
        )
    return inside


def _after_heading(problem: Problem, hint: str) -> str:
    """Return what to do, after a check of the heading where one is given."""
    if problem.heading is None:
        return hint
    return Text(
        "check the heading, which counts anticlockwise from grid east ({} takes a bearing); {}",
        "--compass", hint,
    )  # fmt: skip


def _refuse_unfit(problem: Problem, answer: Hypothesis) -> None:
    """Refuse a hypothesis with too few samples on lanes, or whose fit did not converge."""
    if answer.fit.fitness < LEAST_FITNESS:
        raise NoAnswerError(
            "{}: no pose within {:.0f} m of the guess puts the traffic on the lanes; the "
            "best one {:.0%} of it",
            problem.name,
            GUESS_M,
            answer.fit.fitness,
            hint=_after_heading(
                problem,
                Text(
                    "check the guess, the map, whether the recording is this sensor's, and that "
                    "its y axis points to the left"
                ),
            ),
        )
    if not answer.fit.converged:
        raise NoAnswerError("{}: the fit did not come to rest", problem.name)


def _is_same_answer(answer: Hypothesis, rival: Hypothesis) -> bool:
    """Return whether two optima are within `_ONE_ANSWER_M` and `_ONE_ANSWER_RAD`."""
    gap = rival.fit.state.difference(answer.fit.state)
    return bool(np.hypot(*gap[:2]) < _ONE_ANSWER_M and abs(gap[5]) < _ONE_ANSWER_RAD)


def _not_ruled_out(answer: Hypothesis, others: list[Hypothesis], scene: Scene) -> list[Hypothesis]:
    """Return the other hypotheses over which the z score is below `CLEAR`, widened by profile."""
    return [
        widen_by_profile(scene, h)
        for h in others
        if h.fit.fitness >= LEAST_FITNESS and advantage(answer.fit, h.fit, scene.samples) < CLEAR
    ]


def _distinct(answers: list[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses without equal ones: widening may move two to one pose."""
    return [
        each
        for k, each in enumerate(answers)
        if not any(_is_same_answer(other, each) for other in answers[:k])
    ]


def _ambiguous_error(
    problem: Problem, answer: Hypothesis, rival: Hypothesis, answers: tuple[Localization, ...]
) -> AmbiguousError:
    """Return the error that two poses fit, with both and the localizations of all that fit."""
    gap = rival.fit.state.difference(answer.fit.state)
    return AmbiguousError(
        "{}: ambiguous, two poses {:.1f} m and {:.1f} deg apart put {:.0%} and {:.0%} of "
        "the traffic on lanes",
        problem.name,
        float(np.hypot(*gap[:2])),
        abs(math.degrees(gap[5])),
        answer.fit.fitness,
        rival.fit.fitness,
        hint=Text(
            "record longer, give a heading, or a scan ({}): what stands may decide", "--scan"
        ),
        answers=answers,
    )


def _localization(
    problem: Problem,
    moving: Moving,
    scene: Scene,
    best: Hypothesis,
    hypotheses: list[Hypothesis],
    z_score: float,
) -> Localization:
    """Return the localization of an accepted hypothesis, with its evidence."""
    known = certainty(best.fit, rival=best.rival)
    samples = scene.samples
    evidence = {
        **stated(known.covariance),
        **common(moving, "lane"),
        "converged": best.fit.converged,
        "fitness": best.fit.fitness,
        "observable": known.observable,
    }
    return Localization(
        pose=problem.pose(best.fit.state, evidence),
        fitness=best.fit.fitness,
        observable=known.observable,
        eigenvalues=tuple(known.eigenvalues.tolist()),
        hypotheses=tuple(
            (
                float(h.fit.state.position[0] + problem.guess[0]),
                float(h.fit.state.position[1] + problem.guess[1]),
                float(np.degrees(h.fit.state.yaw_pitch_roll[0])),
                h.loss,
            )
            for h in hypotheses
        ),
        vehicles=samples.tracks,
        samples=len(samples),
        z_score=z_score,
        traces=samples.points,
        range_rate=samples.range_rate,
    )
