"""Compare explanations of where vehicles drive: by the given pose, and by usual mistakes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from gis_radar.base import Text
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.check.offsets import fits_if
from gis_radar.calibration.check.rivals import (
    AGAINST,
    REFLECTION_M,
    LaneMap,
    Rival,
    Score,
    height_or_pitch_mistakes,
    other_yaws,
    score,
    search_poses,
    signs_lost,
    usual_mistakes,
)
from gis_radar.calibration.findings import (
    FITS,
    ONE_PLACE,
    UNKNOWN_CAUSE,
    Finding,
    join_mistakes,
    wrong,
)
from gis_radar.calibration.unit_mistakes import UnitMistake
from gis_radar.poses import Pose

# Least share of vehicles on lanes at which a pose fits: right poses have 0.85 and more.
FIT_SHARE = 0.75
# A rival must put LEAST_GAIN more of the vehicles on lanes than the given pose (a right pose leaves
# a fifth of them off the lanes, too), LEAST_SHARE of all, and have a z score of LEAST_Z over it.
# Rivals within a z score of AS_LIKELY of the best are as likely. A mistake is only named if the
# pose fits once it is corrected; a pose is only searched where no mistake can be named.
LEAST_GAIN, LEAST_SHARE, LEAST_Z, AS_LIKELY = 0.2, 0.65, 4.0, 3.0
FOUND_SHARE = 0.8  # least share of a searched pose: a search explains a part of any traffic
# Where no rival fits, a pose is wrong if its share exceeds that of turned sensors by less than
# OVER_CHANCE, or is below LEAST_SHARE; up to FIT_SHARE it is doubted, as maps lack lanes.
OVER_CHANCE = 0.1
# Share of the vehicles that right poses put on lanes, and the standard errors of a binomial
# proportion by which a sample of few vehicles may fall short of it.
RIGHT_SHARE, SIGMAS_BELOW = 0.84, 3.0
MOST_CAUSES = 2  # if more causes are equally likely, none is named
HIGH_M = 1.5  # larger errors of the median height over the road may be of height or tilt
# Where all range rates have one sign, signs are lost if so many vehicles (number, and share of all)
# drive along lanes only with the other sign: few vehicles drive against a lane.
BACKWARDS, BACKWARDS_SHARE = 5, 0.1

BESIDE_LANES = Text("many vehicles drive beside the lanes")


def compare_explanations(
    excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose],
    units: Sequence[UnitMistake] = (),
) -> Finding:  # fmt: skip
    """Judge a pose by whether vehicles drive along lanes with it, or with a mistake corrected.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    others : mapping of str to Pose
        The poses of the site's other sensors.
    units : sequence of UnitMistake
        Units of the positions that the range rates do not rule out.
    """
    given, without_heights = score(excerpt, lanes), score(excerpt, lanes, Rival(heights=False))
    heights_m = without_heights.height_over_m[np.isfinite(without_heights.height_over_m)]
    height_off = len(heights_m) > 0 and abs(float(np.median(heights_m)) - REFLECTION_M) > HIGH_M
    evidence = Text(
        "with this pose {:.0%} of {} recorded vehicles drive along lanes of the map",
        given.share, len(given.on_lane),
    )  # fmt: skip
    if given.share >= FIT_SHARE and not height_off:
        without_sign = signs_lost(excerpt)
        if without_sign and _drives_backwards(excerpt, lanes, given):
            return wrong(evidence, without_sign.cause, without_sign.advice)
        return Finding(sensor="", verdict=FITS, evidence=evidence)
    rivals = usual_mistakes(excerpt, others, units)
    rivals += height_or_pitch_mistakes(excerpt, without_heights) if height_off else []
    least = given.share + (0.0 if height_off else LEAST_GAIN)
    likely = likeliest(excerpt, given, scored(excerpt, lanes, rivals), least)
    named = [each for each in likely if fits_if(excerpt, lanes, each[0])]
    if given.share < FIT_SHARE and (not named or named[0][0] is AGAINST):
        searched = scored(excerpt, lanes, search_poses(excerpt, lanes))
        searched = likeliest(excerpt, given, searched, max(least, FOUND_SHARE))[:1]
        searched = [each for each in searched if fits_if(excerpt, lanes, each[0])]
        if not named or (searched and named[0][1].z_score_over(searched[0][1]) < AS_LIKELY):
            named = searched + named  # a map with swapped bounds is no likelier than a pose
    if named:
        if named[0][0].assumes_two_mistakes(excerpt.usual) or len(named) > MOST_CAUSES:
            with_other = Text("{}, {:.0%} with another pose", evidence, named[0][1].share)
            return wrong(with_other, UNKNOWN_CAUSE, ONE_PLACE)
        if_so = Text("{}, {:.0%} after this correction", evidence, named[0][1].share)
        return wrong(if_so, *join_mistakes((rival.cause, rival.advice) for rival, _ in named))
    random_share = 0.0
    if given.share < FIT_SHARE:
        yaws = scored(excerpt, lanes, other_yaws(excerpt.usual))
        random_share = max(each.share for _, each in yaws)
    if given.share < least_share(len(given.on_lane), random_share + OVER_CHANCE):
        by_chance = Text("{}, {:.0%} with the sensor turned at random", evidence, random_share)
        return wrong(by_chance, UNKNOWN_CAUSE, ONE_PLACE)
    beside = {} if given.share >= FIT_SHARE else {
        "cause": BESIDE_LANES,
        "advice": Text("check whether the map lacks lanes, or the pose is another sensor's"),
    }  # fmt: skip
    return Finding(sensor="", verdict=FITS, evidence=evidence, **beside)


def least_share(vehicles: int, random_share: float = 0.0) -> float:
    """Return the least share of vehicles on lanes at which a pose may still fit.

    Parameters
    ----------
    vehicles : int
        Number of vehicles: the share of fewer ones scatters more.
    random_share : float
        Share with the sensor turned at random, plus a margin.
    """
    usual_least = RIGHT_SHARE - SIGMAS_BELOW * np.sqrt(RIGHT_SHARE * (1.0 - RIGHT_SHARE) / vehicles)
    return float(min(max(LEAST_SHARE, min(random_share, FIT_SHARE)), usual_least))


ScoredRivals = list[tuple[Rival, Score]]


def _drives_backwards(excerpt: Excerpt, lanes: LaneMap, given: Score) -> bool:
    """Return whether many vehicles drive along lanes only with range rates of the other sign."""
    any_sign = score(excerpt, lanes, Rival(signless=True))
    backwards = int((any_sign.driving & ~given.driving).sum())
    return backwards >= max(BACKWARDS, BACKWARDS_SHARE * len(given.on_lane))


def scored(excerpt: Excerpt, lanes: LaneMap, rivals: Iterable[Rival]) -> ScoredRivals:
    """Return pairs of each rival and its score on the lanes."""
    return [(rival, score(excerpt, lanes, rival)) for rival in rivals]


def likeliest(excerpt: Excerpt, given: Score, tried: ScoredRivals, least: float) -> ScoredRivals:
    """Return the rivals of highest likelihood among those much better than the given pose.

    Of equivalent rivals only the simplest stays, and rivals of two mistakes only stay where no
    single mistake is as likely.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    given : Score
        The score of the given pose.
    tried : list of (Rival, Score)
        The rivals.
    least : float
        Least share of the vehicles that a rival has to explain.
    """
    better = [
        entry
        for entry in tried
        if entry[1].share >= max(least, LEAST_SHARE) and entry[1].z_score_over(given) >= LEAST_Z
    ]
    better.sort(key=lambda entry: -float(entry[1].log_likelihood.sum()))
    as_likely = [
        entry
        for entry in better
        if entry is better[0] or better[0][1].z_score_over(entry[1]) < AS_LIKELY
    ]
    as_likely.sort(
        key=lambda entry: (entry[0].assumes_two_mistakes(excerpt.usual), entry[0].fitted)
    )
    distinct: ScoredRivals = []
    for entry in as_likely:
        if distinct and entry[0].assumes_two_mistakes(excerpt.usual):
            break
        if not any(entry[0].is_equivalent(earlier, excerpt.usual) for earlier, _ in distinct):
            distinct.append(entry)
    return distinct
