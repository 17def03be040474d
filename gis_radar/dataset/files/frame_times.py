"""Steps in which sensors delivered frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import pyarrow.compute as pc

from gis_radar.base import (
    STEPS_PER_HOUR,
    Booleans,
    InputError,
    Integers,
    Text,
    iso_from_step,
    step_of,
)
from gis_radar.dataset.files.parts import MEASURE_AGAIN
from gis_radar.dataset.files.records import HourRecord, Span, read_rows
from gis_radar.dataset.files.source import DatasetFiles, Moment, NotMeasuredError, require_measured
from gis_radar.dataset.files.tables import FRAMES, RECORDINGS
from gis_radar.measures import LONGEST_VALID_STEPS, Runs, union_of_runs, valid_steps


def frame_steps(dataset: DatasetFiles, sensor: str | None = None, *, valid: bool = True) -> Runs:
    """Return the steps in which a frame is valid, or into which one falls.

    Hours whose frames were deleted are taken as recorded without a gap, from the first to the
    last frame of each recording.

    Parameters
    ----------
    sensor : str, optional
        Name of the sensor; by default any sensor counts.
    valid : bool
        If False, return only the steps into which a frame falls.

    Raises
    ------
    InputError
        If there is no such sensor.
    """
    records = dataset.records()
    with_frames = {hour: each for hour, each in records.items() if each.has(FRAMES)}
    parts = [*_stored(dataset, with_frames, sensor, valid=valid)]
    if dropped := records.keys() - with_frames.keys():
        parts += _recorded(dataset, dropped, sensor, valid=valid)
    steps = union_of_runs(parts) if parts else None
    if steps is None or not len(steps):
        raise InputError(
            "{}: holds no frame",
            dataset.folder,
            hint="measuring was interrupted, or recordings are empty",
        )
    return steps


def _stored(
    dataset: DatasetFiles, records: Mapping[int, HourRecord], sensor: str | None, *, valid: bool
) -> Iterator[Runs]:
    """Yield the steps of the frames of some hours."""
    columns = ["sensor", "first_step", "last_step"]
    for rows in read_rows(dataset.folder, FRAMES, records, columns=columns):
        if sensor is not None:
            rows = rows.filter(pc.equal(rows["sensor"], sensor))  # noqa: PLW2901
        first, last = (rows[name].to_numpy() for name in ("first_step", "last_step"))
        if len(last) and np.max(last - first) > LONGEST_VALID_STEPS:
            raise InputError(
                "{}: frames are valid for too long", dataset.folder, hint=MEASURE_AGAIN
            )
        yield union_of_runs([Runs(first=first, last=last if valid else first)])


def _recorded(
    dataset: DatasetFiles, hours: Iterable[int], sensor: str | None, *, valid: bool
) -> Iterator[Runs]:
    """Yield the steps of recordings in hours without frames: from their first to their last."""
    recorded = recording_steps(dataset, sensor, valid=valid)
    begins = np.array(sorted(hours), np.int64) * STEPS_PER_HOUR
    blocks = union_of_runs([Runs(first=begins, last=begins + STEPS_PER_HOUR - 1)])
    for block in zip(blocks.first.tolist(), blocks.last.tolist(), strict=True):
        yield recorded.within(*block)


def recording_steps(
    dataset: DatasetFiles, sensor: str | None = None, *, valid: bool = False
) -> Runs:
    """Return the steps from the first to the last frame of each recording."""
    rows = dataset.single_table(RECORDINGS)
    if sensor is not None:
        rows = rows.filter(pc.equal(rows["sensor"], sensor))
    first, last = (step_of(rows[name].to_numpy()) for name in ("first_time", "last_time"))
    if valid:
        valid_after = [valid_steps(each) for each in rows["validity_s"].to_pylist()]
        last = last + np.array(valid_after, np.int64)
    return union_of_runs([Runs(first=first, last=last)])


def recorded_span(dataset: DatasetFiles, begin: Moment, end: Moment, steps: int = 1) -> Span | None:
    """Return the first and the last step of a time, None for all; refuse one without frames.

    Parameters
    ----------
    dataset : DatasetFiles
        The dataset.
    begin, end : str, datetime or step, optional
        The time.
    steps : int
        Length of the intervals that begin in it.

    Raises
    ------
    NotMeasuredError
        If no such interval has a part of a recording.
    """
    if (span := dataset.span(begin, end)) is None:
        return None
    require_measured(dataset, span)
    recorded = recording_steps(dataset)
    first, last = -(-span[0] // steps) * steps, span[1] // steps * steps + steps - 1
    if len(recorded) and (first > last or not len(recorded.within(first, last))):
        place = np.searchsorted(recorded.first, recorded.nearest(first), side="right") - 1
        nearest = (iso_from_step(int(each[place])) for each in (recorded.first, recorded.last))
        hint = Text(
            "the nearest recording goes from {} to {}; an interval counts if it begins in the "
            "time asked for", *nearest,
        )  # fmt: skip
        if len(recorded.within(*span)):
            raise NotMeasuredError(
                "{}: no interval with a recording begins in that time", dataset.folder, hint=hint
            )
        raise NotMeasuredError("{}: nothing was measured in that time", dataset.folder, hint=hint)
    return span


def follow_a_recording(dataset: DatasetFiles, first: Integers, steps: int) -> Booleans:
    """Return which intervals hold no frame, only the time in which an earlier one is still valid.

    Parameters
    ----------
    first : (n,) array of int
        First steps of the intervals.
    steps : int
        Their length.
    """
    recorded, valid = (recording_steps(dataset, valid=each) for each in (False, True))
    reached, still_valid = (
        np.append(runs.last, -1)[np.searchsorted(runs.first, first + steps) - 1] >= first
        for runs in (recorded, valid)
    )
    return np.asarray(still_valid & ~reached)
