"""Old poses: a sensor that is followed brings another pose every few seconds, for years.

Kept is what a frame on disk names, what a message that may still come can name, and what decides
which views later poses share; so hours come out as if all were kept.
"""

from __future__ import annotations

from collections.abc import Collection, MutableMapping
from typing import NamedTuple

from gis_radar.live.journal import Journal, PoseName
from gis_radar.live.store import KnownPose

FEW = 8  # poses of a sensor that are not worth a look


class PosesOfSensor(NamedTuple):
    """What of a sensor's state says which poses count.

    Parameters
    ----------
    sensor : str
        Its name.
    heads : collection of int
        Ids of the poses that may stand for the next one.
    poses : dict
        By stream and number, the id of the row in the journal.
    """

    sensor: str
    heads: Collection[int]
    poses: MutableMapping[tuple[str, int], int]


def drop_old_poses(
    standing: PosesOfSensor, known: MutableMapping[int, KnownPose], journal: Journal
) -> int:
    """Drop a sensor's poses that nothing needs any more; return how many.

    Parameters
    ----------
    standing : PosesOfSensor
        Of the sensor; dropped ones leave its poses.
    known : dict
        The poses of all sensors, by id.
    journal : Journal
        Which holds poses and frames.

    Raises
    ------
    OutputError
        If the journal cannot be written.
    """
    if len(standing.poses) <= FEW:
        return 0
    rows = journal.pose_names(standing.sensor)
    kept = journal.poses_named(standing.sensor) | _of_streams(rows, journal, standing.sensor)
    # the last that each head stood for, too: it says in which order they were met
    last = {row.standing: row.id for row in rows}
    kept |= {*standing.heads, *(last[head] for head in standing.heads if head in last)}
    kept |= {row.standing for row in rows if row.id in kept}
    dropped = [row for row in rows if row.id not in kept]
    journal.drop_poses([row.id for row in dropped])
    for row in dropped:
        known.pop(row.id, None)
        standing.poses.pop((row.stream, row.number), None)
    return len(dropped)


def _of_streams(rows: Collection[PoseName], journal: Journal, sensor: str) -> set[int]:
    """Return the pose in force where each stream is stored, and all later ones."""
    marks = journal.marks()
    found, in_force = set(), {}
    for row in sorted(rows, key=lambda row: row.number):
        if row.number <= marks.get((sensor, row.stream), 0):
            in_force[row.stream] = row.id
        else:
            found.add(row.id)
    return found | {*in_force.values()}
