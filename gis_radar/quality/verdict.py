"""Verdicts: the tests of detector health, in words.

The tests are those that freeway operators run on loop detectors (PeMS), carried over to radar: no
data, too few samples, never occupied, occupied too much, constant, and hits without motion.
"""

from __future__ import annotations

from collections.abc import Iterator

from gis_radar.quality.counting import HIGH, Count

GOOD = "good"
NO_DATA = "no data"
LEAST_SHARE = 0.6  # of the frames expected
HIGH_SHARE = 0.2  # of the frames may have more than `HIGH` of the tiles hit
STILL_SHARE = 0.001  # of the detections move at least
TWICE_SHARE = 0.05
REPEATED_SHARE = 0.2
WILD_SHARE = 0.02
FRAMES_ENOUGH = 100
CLOCKS_SET_S = 631_152_000  # 1990


def faults_of(count: Count, hour: int) -> Iterator[str]:
    """Yield what is wrong with a sensor in an hour, worst first; nothing where it is well.

    Parameters
    ----------
    count : Count
        What it delivered. Under 100 frames only their number is judged.
    hour : int
        UNIX second in which the hour began.
    """
    if count.frames == 0:
        yield NO_DATA
        return
    single = count.frames - count.doubled
    expected = single + count.dropped
    if single < LEAST_SHARE * expected:
        yield f"{100 * single / expected:.0f} % of the frames expected"
    if hour < CLOCKS_SET_S:
        yield "clock not set"
    if count.frames >= FRAMES_ENOUGH:
        yield from _faults_of_frames(count)


def _faults_of_frames(count: Count) -> Iterator[str]:
    if count.doubled > TWICE_SHARE * count.frames:
        yield f"{100 * count.doubled / count.frames:.0f} % of the frames come twice"
    if count.repeated > REPEATED_SHARE * count.frames:
        yield f"frozen: {100 * count.repeated / count.frames:.0f} % of the frames repeat the last"
    if count.detections == 0:
        yield "all frames are empty"
        return
    if count.seen == 0:
        yield "sees no tile"
    elif count.hits == 0:
        yield "no tile is ever hit"
    elif count.high > HIGH_SHARE * count.frames:
        yield (
            f"over {100 * HIGH:.0f} % of its tiles hit in "
            f"{100 * count.high / count.frames:.0f} % of the frames"
        )
    elif count.fewest == count.most:
        yield "occupancy is constant"
    if count.hits and count.moving < STILL_SHARE * count.detections:
        yield "hits without motion"
    if count.wild > WILD_SHARE * count.detections:
        yield f"{100 * count.wild / count.detections:.0f} % of the detections are absurdly fast"
