"""Compare explanations of where vehicles drive: the pose as given, and its rivals."""

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
    found_poses,
    lower_or_tilted,
    other_yaws,
    score,
    signs_lost,
    ways_to_be_wrong,
)
from gis_radar.calibration.findings import (
    FITS,
    ONE_PLACE,
    UNKNOWN_CAUSE,
    Finding,
    either,
    wrong,
)
from gis_radar.calibration.unit_mistakes import UnitMistake
from gis_radar.poses import Pose

FITTING = 0.75  # share of vehicles on lanes from which a pose fits; right ones show 0.85 and more
# A rival must explain MORE of the vehicles than the given pose (a fifth of them is off the lanes at
# right poses too), LEAST_SHARE of all, and be CLEAR standard errors better. Rivals within BESIDE
# standard errors of it are as likely. A mistake is named if all fits once it is corrected, so that
# a pose is only searched where none is.
MORE, LEAST_SHARE, CLEAR, BESIDE = 0.2, 0.65, 4.0, 3.0
FOUND_SHARE = 0.8  # least share for a searched pose, as such a one explains a part of any traffic
# Where no rival fits, a pose is wrong if it explains hardly more (OVER_CHANCE) than random yaws do,
# or less than LEAST_SHARE; up to FITTING it is doubted, as maps lack lanes.
OVER_CHANCE = 0.1
# Least share of the vehicles that right poses put on lanes, and the standard errors by which a
# right pose with few vehicles may fall short of it.
RIGHT_SHARE, BELOW = 0.84, 3.0
MOST_CAUSES = 2  # most equally likely causes that are named; of more, none is
HIGH_M = 1.5  # error of the median height over the road from which a height or tilt may be wrong
# Number and share of vehicles that drive along lanes only with range rates of the other sign, from
# which on signs are lost, where all are of one sign: few vehicles drive against a lane.
BACKWARDS, BACKWARDS_SHARE = 5, 0.1

BESIDE_LANES = Text("many vehicles drive beside the lanes")


def by_lanes(
    excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose],
    units: Sequence[UnitMistake] = (),
) -> Finding:  # fmt: skip
    """Compare rival explanations of where vehicles drive.

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
    given, flat = score(excerpt, lanes), score(excerpt, lanes, Rival(heights=False))
    known = flat.over[np.isfinite(flat.over)]
    high = len(known) > 0 and abs(float(np.median(known)) - REFLECTION_M) > HIGH_M
    evidence = Text(
        "with this pose {:.0%} of {} recorded vehicles drive along lanes of the map",
        given.share, len(given.on),
    )  # fmt: skip
    if given.share >= FITTING and not high:
        lost = signs_lost(excerpt)
        if lost and _backwards(excerpt, lanes, given):
            return wrong(evidence, lost.cause, lost.advice)
        return Finding(sensor="", verdict=FITS, evidence=evidence)
    rivals = ways_to_be_wrong(excerpt, others, units)
    rivals += lower_or_tilted(excerpt, flat) if high else []
    least = given.share + (0.0 if high else MORE)
    likely = likeliest(excerpt, given, scored(excerpt, lanes, rivals), least)
    best = [each for each in likely if fits_if(excerpt, lanes, each[0])]
    if given.share < FITTING and (not best or best[0][0] is AGAINST):
        searched = scored(excerpt, lanes, found_poses(excerpt, lanes))
        found = likeliest(excerpt, given, searched, max(least, FOUND_SHARE))
        found = [each for each in found[:1] if fits_if(excerpt, lanes, each[0])]
        if not best or (found and best[0][1].ahead_of(found[0][1]) < BESIDE):
            best = found + best  # a map with swapped bounds is no likelier than a pose
    if best:
        if best[0][0].twofold(excerpt.usual) or len(best) > MOST_CAUSES:
            others_too = Text("{}, {:.0%} with another pose", evidence, best[0][1].share)
            return wrong(others_too, UNKNOWN_CAUSE, ONE_PLACE)
        if_so = Text("{}, {:.0%} after this correction", evidence, best[0][1].share)
        return wrong(if_so, *either((rival.cause, rival.advice) for rival, _ in best))
    chance = 0.0
    if given.share < FITTING:
        yaws = scored(excerpt, lanes, other_yaws(excerpt.usual))
        chance = max(each.share for _, each in yaws)
    if given.share < least_share(len(given.on), chance + OVER_CHANCE):
        by_chance = Text("{}, {:.0%} with the sensor turned at random", evidence, chance)
        return wrong(by_chance, UNKNOWN_CAUSE, ONE_PLACE)
    beside = {} if given.share >= FITTING else {
        "cause": BESIDE_LANES,
        "advice": Text("check whether the map lacks lanes, or the pose is another sensor's"),
    }  # fmt: skip
    return Finding(sensor="", verdict=FITS, evidence=evidence, **beside)


def least_share(vehicles: int, by_chance: float = 0.0) -> float:
    """Return the least share of vehicles on lanes at which a pose may still fit.

    Parameters
    ----------
    vehicles : int
        Number of vehicles: the fewer, the farther a right pose may fall short of the usual share.
    by_chance : float
        Share that random yaws explain, plus a margin.
    """
    drawn = RIGHT_SHARE - BELOW * np.sqrt(RIGHT_SHARE * (1.0 - RIGHT_SHARE) / vehicles)
    return float(min(max(LEAST_SHARE, min(by_chance, FITTING)), drawn))


Tried = list[tuple[Rival, Score]]


def _backwards(excerpt: Excerpt, lanes: LaneMap, given: Score) -> bool:
    """Return whether vehicles drive along lanes backwards, where range rates have one sign."""
    either_way = score(excerpt, lanes, Rival(signless=True))
    more = int((either_way.driving & ~given.driving).sum())
    return more >= max(BACKWARDS, BACKWARDS_SHARE * len(given.on))


def scored(excerpt: Excerpt, lanes: LaneMap, rivals: Iterable[Rival]) -> Tried:
    """Return rivals, each with its score on the lanes."""
    return [(rival, score(excerpt, lanes, rival)) for rival in rivals]


def likeliest(excerpt: Excerpt, given: Score, tried: Tried, least: float) -> Tried:
    """Return the rivals that explain the traffic best and clearly better than what is given.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    given : Score
        The score of what is given.
    tried : list of (Rival, Score)
        The rivals.
    least : float
        Least share of the vehicles that a rival has to explain.
    """
    good = [
        one
        for one in tried
        if one[1].share >= max(least, LEAST_SHARE) and one[1].ahead_of(given) >= CLEAR
    ]
    good.sort(key=lambda one: -float(one[1].fit.sum()))
    alike = [one for one in good if one is good[0] or good[0][1].ahead_of(one[1]) < BESIDE]
    alike.sort(key=lambda one: (one[0].twofold(excerpt.usual), one[0].fitted))
    kept: Tried = []
    for one in alike:  # of equal rivals the simplest; two mistakes at once only if no single one
        if kept and one[0].twofold(excerpt.usual):
            break
        if not any(one[0].same_as(other, excerpt.usual) for other, _ in kept):
            kept.append(one)
    return kept
