"""Choose the mistake that best explains where a sensor's vehicles drive, or none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeAlias

import numpy as np
import scipy

from gis_radar.base import Text
from gis_radar.calibration.check.evidence import MEAN_REFLECTION_M, LaneMap, Score, score
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.check.fitted_pose import fits_if
from gis_radar.calibration.check.mistakes import (
    AGAINST,
    SIGNLESS,
    Mistake,
    of_height,
    other_yaws,
    search_poses,
    usual_mistakes,
)
from gis_radar.calibration.findings import FITS, NOT_ONE_PLACE, Cause, Finding, judged, wrong
from gis_radar.poses import Pose

# Least share of vehicles on lanes at which a pose fits: right poses have 0.85 and more.
_FIT_SHARE = 0.75
# A mistake must put _LEAST_GAIN more of the vehicles on lanes than the given pose (a right pose
# leaves a fifth of them off, too), LEAST_ON_LANES of all, and have a z score of _LEAST_Z over it.
# Mistakes within a z score of _AS_LIKELY of the best are as likely. One is only named if the pose
# fits once it is corrected; a pose is only searched where no usual mistake can be named.
_LEAST_GAIN, LEAST_ON_LANES, _LEAST_Z, _AS_LIKELY = 0.2, 0.65, 4.0, 3.0
FOUND_SHARE = 0.8  # least share of a searched pose: a search explains a part of any traffic
# Where no mistake fits, a pose is wrong if its share exceeds that of turned sensors by less than
# _OVER_CHANCE, or is below LEAST_ON_LANES; up to _FIT_SHARE it is doubted, as maps lack lanes.
_OVER_CHANCE = 0.1
# Share of the vehicles that right poses put on lanes, and the probability with which a sample of
# few vehicles may fall short of it (three standard deviations).
_RIGHT_SHARE, _SHORT_BY_CHANCE = 0.84, 0.00135
_MOST_CAUSES = 2  # if more causes are equally likely, none is named
_HIGH_M = 1.5  # larger errors of the median height over the road may be of height or tilt
# Where all range rates have one sign, signs are lost if so many vehicles (number, and share of all)
# drive along lanes only with the other sign: few vehicles drive against a lane.
_BACKWARDS, _BACKWARDS_SHARE = 5, 0.1

BESIDE_LANES = Cause(
    Text("many vehicles drive beside the lanes"),
    Text(
        "check whether the map lacks lanes, the pose is another sensor's, or the recording has "
        "frames of two sensors"
    ),
)
ScoredMistakes: TypeAlias = list[tuple[Mistake, Score]]


def compare_explanations(
    excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose], *, units_known: bool = True
) -> Finding:
    """Judge a pose by whether vehicles drive along lanes with it, or with a mistake corrected.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    others : mapping of str to Pose
        The poses of the site's other sensors.
    units_known : bool
        Whether the range rates show that the units, and their sign, are right.
    """
    given, flat = score(excerpt, lanes), score(excerpt, lanes, heights=False)
    heights_m = flat.height_over_m[np.isfinite(flat.height_over_m)]
    height_off = (
        len(heights_m) > 0 and abs(float(np.median(heights_m)) - MEAN_REFLECTION_M) > _HIGH_M
    )
    evidence = Text(
        "with this pose {:.0%} of {} recorded vehicles drive along lanes of the map",
        given.share, len(given.on_lane),
    )  # fmt: skip
    if given.share >= _FIT_SHARE and not height_off:
        lost = excerpt.one_sign and _drive_backwards(excerpt, lanes, given)
        return wrong(evidence, *SIGNLESS.causes) if lost else judged(FITS, evidence)
    mistakes = usual_mistakes(excerpt, others, units_known=units_known)
    mistakes += of_height(excerpt, flat) if height_off else []
    least = given.share + (0.0 if height_off else _LEAST_GAIN)
    named = best_mistakes(excerpt, lanes, given, mistakes, least)
    named = [each for each in named if fits_if(excerpt, lanes, each[0])]
    if given.share < _FIT_SHARE and (not named or AGAINST in named[0][0].causes):
        poses = search_poses(excerpt, lanes)
        found = best_mistakes(excerpt, lanes, given, poses, max(least, FOUND_SHARE))[:1]
        found = [each for each in found if fits_if(excerpt, lanes, each[0])]
        if not named or (found and named[0][1].z_score_over(found[0][1]) < _AS_LIKELY):
            named = found + named  # a map with swapped bounds is no likelier than a pose
    if named:
        return explained(excerpt, evidence, named)
    if given.share >= _FIT_SHARE:
        return judged(FITS, evidence)
    turned = [each.score(excerpt, lanes) for each in other_yaws(excerpt.usual)]
    random_share = max(each.share for each in turned)
    if given.share < least_share(len(given.on_lane), random_share + _OVER_CHANCE):
        by_chance = Text("{}, {:.0%} with the sensor turned at random", evidence, random_share)
        return wrong(by_chance, NOT_ONE_PLACE)
    return judged(FITS, evidence, BESIDE_LANES)


def explained(excerpt: Excerpt, evidence: str, named: ScoredMistakes) -> Finding:
    """Return the finding that one of some mistakes was made, or an unknown one of too many.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    evidence : str
        The numbers with the given pose.
    named : list of (Mistake, Score)
        The mistakes, likeliest first.
    """
    best, with_best = named[0]
    if best.is_twofold(excerpt.usual) or len(named) > _MOST_CAUSES:
        with_other = Text("{}, {:.0%} with another pose", evidence, with_best.share)
        return wrong(with_other, NOT_ONE_PLACE)
    if_so = Text("{}, {:.0%} after this correction", evidence, with_best.share)
    return wrong(if_so, *(cause for mistake, _ in named for cause in mistake.causes))


def least_share(vehicles: int, random_share: float = 0.0) -> float:
    """Return the least share of vehicles on lanes at which a pose may still fit.

    Parameters
    ----------
    vehicles : int
        Number of vehicles: the share of fewer ones scatters more.
    random_share : float
        Share with the sensor turned at random, plus a margin.
    """
    usual_least = scipy.stats.binom.ppf(_SHORT_BY_CHANCE, vehicles, _RIGHT_SHARE) / vehicles
    return float(min(max(LEAST_ON_LANES, min(random_share, _FIT_SHARE)), usual_least))


def _drive_backwards(excerpt: Excerpt, lanes: LaneMap, given: Score) -> bool:
    """Return whether many vehicles drive along lanes only with range rates of the other sign."""
    backwards = int((SIGNLESS.score(excerpt, lanes).driving & ~given.driving).sum())
    return backwards >= max(_BACKWARDS, _BACKWARDS_SHARE * len(given.on_lane))


def best_mistakes(
    excerpt: Excerpt, lanes: LaneMap, given: Score, tried: Iterable[Mistake], least: float
) -> ScoredMistakes:
    """Return the likeliest mistakes that explain much more than the given pose, with their scores.

    Of equivalent mistakes only the simplest stays, and twofold ones only stay where no single
    mistake is as likely.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    given : Score
        The score of the given pose.
    tried : iterable of Mistake
        The mistakes.
    least : float
        Least share of the vehicles that a mistake has to explain.
    """
    scored = [(each, each.score(excerpt, lanes)) for each in tried]
    better = [
        (mistake, found)
        for mistake, found in scored
        if found.share >= max(least, LEAST_ON_LANES) and found.z_score_over(given) >= _LEAST_Z
    ]
    better.sort(key=lambda each: -float(each[1].log_likelihood.sum()))
    as_likely = [
        each
        for each in better
        if each is better[0] or better[0][1].z_score_over(each[1]) < _AS_LIKELY
    ]
    pose = excerpt.usual
    as_likely.sort(key=lambda each: (each[0].is_twofold(pose), each[0].fitted))
    distinct: ScoredMistakes = []
    for each in as_likely:
        if distinct and each[0].is_twofold(pose):
            break
        if not any(each[0].is_equivalent(earlier, pose) for earlier, _ in distinct):
            distinct.append(each)
    return distinct
