"""Lane measures and turns: traffic by lane and quarter of an hour, from the tracks of each hour.

The rows of an hour follow from its own parts and from the tracks that it continues from the hour
before: from these it is known which vehicles have crossed a line, and which were standing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyogrio

from gis_radar.base import STEPS_PER_HOUR, STEPS_PER_SECOND, InputError, Integers, opened_package
from gis_radar.dataset.days.tables import QUARTERS, STEPS_PER_QUARTER, DayTables, records_of
from gis_radar.dataset.days.tile_counts import TileCounts, count_spans
from gis_radar.dataset.files.manifest import TILES_FILE
from gis_radar.dataset.files.parts import HOURS_PER_DAY, Keys, days_of, hour_text
from gis_radar.dataset.files.records import HourRecord, Span, read_hour
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.tables import (
    CONTINUED,
    LANE_MEASURES,
    OBSERVED,
    TILE_COUNTS,
    TRACKS,
    TURNS,
    VEHICLES,
    VISIBLE,
)
from gis_radar.hdmap import LANES_LAYER, read_tiles
from gis_radar.measures import (
    FrontStates,
    LaneNetwork,
    Measured,
    QueueCourse,
    StepGrid,
    TileSteps,
    TrackedLanes,
    VehicleTable,
    VisibleRuns,
    measure_lanes,
    queue_course,
)

LANES_METHOD = 9
"""Raised whenever the same parts would give other lane measures or turns."""

_TILE_COLUMNS = (
    "visible_steps", "hidden_steps", "occupied_steps", "inferred_steps", "occupied_variance"
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneTraffic(DayTables):
    """Maker and reader of the lane measures and turns of a dataset.

    Parameters
    ----------
    folder, fingerprint
        As for :class:`~gis_radar.dataset.days.tables.DayTables`.
    line_m : mapping, optional
        By number of the lane: the counting line, m along the lane, in place of the stop line or the
        middle. Such traffic is measured by :meth:`finer`, and never stored.
    """

    tables = (LANE_MEASURES, TURNS)
    line_m: Mapping[int, float] = field(default_factory=dict)
    _before: dict[int, HourRecord | None] = field(default_factory=dict, repr=False)

    @cached_property
    def network(self) -> LaneNetwork:
        """The lanes, read when they are first needed."""
        tiles, columns = read_tiles(self.folder / TILES_FILE), {}
        with opened_package(self.folder / TILES_FILE, what="the tiles of a dataset") as place:
            if LANES_LAYER in pyogrio.list_layers(place)[:, 0]:
                columns = pyogrio.read_dataframe(
                    place, layer=LANES_LAYER, read_geometry=False
                ).to_dict("series")
        lane = columns.get("lane", [])
        stops, limits = (
            dict(zip(lane, columns.get(name, ()), strict=False))
            for name in ("stop_line_m", "speed_limit_kmh")
        )
        network = LaneNetwork.of(tiles, stops, limits)
        lines = [
            self.line_m.get(number, usual)
            for number, usual in zip(network.lane.tolist(), network.line_m.tolist(), strict=True)
        ]
        return replace(network, line_m=np.array(lines, np.float64)) if self.line_m else network

    def remember(self, records: Mapping[int, HourRecord]) -> None:
        """Keep records that were read: rows follow from the hour before, too."""
        self._before.update(_with_tracks(records))

    def keys(self, day: int, records: Mapping[int, HourRecord]) -> Keys:
        """Return the keys of the hours of a date: what the rows of each follow from.

        Hours without vehicles have none. Where exact tables were deleted, the rows stay as they
        were made, if they were.
        """
        keys = {hour: self.key(each) for hour, each in _with_tracks(records).items()}
        gone = {hour for hour in keys if TRACKS.name in records[hour].dropped}
        lanes, turns = (self.file(table, day) for table in self.tables)
        known = lanes.keys() if gone and turns.keys() else {}
        return {
            hour: known[hour] if hour in gone else key
            for hour, key in keys.items()
            if hour not in gone or hour in known
        }

    def key(self, record: HourRecord) -> list[str | int]:
        """Return what the rows of an hour follow from; the first entry is `LANES_METHOD`."""
        before = self._hour_before(record.hour)
        inputs, method = ("", 0) if before is None else (before.origin.inputs, before.origin.method)
        return [LANES_METHOD, record.origin.method, record.origin.inputs, method, inputs]

    def methods(self, records: Mapping[int, HourRecord]) -> set[int]:
        """Return the methods of lane measures of hours: an earlier one where they stay as made."""
        self.remember(records)
        days = {day: self.keys(day, records_of(day, records)) for day in days_of(records)}
        return {int(key[0]) for keys in days.values() for key in keys.values()}

    def _hour_before(self, hour: int) -> HourRecord | None:
        """Return the record of the hour before, if it has tracks."""
        if hour - 1 not in self._before:
            record = read_hour(self.folder, hour - 1)
            self._before[hour - 1] = None
            self._before.update(_with_tracks({} if record is None else {hour - 1: record}))
        return self._before[hour - 1]

    def finer(self, record: HourRecord, steps: int) -> tuple[pa.Table, pa.Table]:
        """Measure an hour by intervals of `steps`, which must divide a quarter of an hour.

        The column `interval` is then the number of the interval in the hour.

        Raises
        ------
        InputError
            If its exact tables were deleted.
        """
        begins = np.arange(0, STEPS_PER_HOUR, steps, dtype=np.int64)
        tiles, sums = count_spans(self.folder, record, begins, begins + steps - 1)
        rows = np.flatnonzero(sums["observed_steps"])
        place, interval = np.divmod(rows, len(begins))
        counts = [sums[name][rows] for name in _TILE_COLUMNS]
        found = self._measure(record, steps, tiles[place], interval, counts)
        return _arrow_tables(found, 0)

    def make(self, record: HourRecord) -> tuple[pa.Table, pa.Table]:
        """Return the rows of an hour by quarters: lane measures, turns."""
        first = record.hour % HOURS_PER_DAY * QUARTERS
        columns = ["tile_id", "interval", *_TILE_COLUMNS]
        counts = TileCounts(folder=self.folder, fingerprint=self.fingerprint)
        (rows,) = counts.read(TILE_COUNTS, {record.hour: record}, None, columns)
        tile, interval, *steps = (each.to_numpy() for each in rows.columns)
        found = self._measure(record, STEPS_PER_QUARTER, tile, interval - first, steps)
        return _arrow_tables(found, first)

    def courses(
        self, records: Mapping[int, HourRecord], lane: int, span: Span
    ) -> list[QueueCourse]:
        """Follow the queue at the stop line of a lane, second by second.

        Parameters
        ----------
        records : mapping
            Records of the hours.
        lane : int
            Number of the lane.
        span : (int, int)
            First and last step.

        Returns
        -------
        list of QueueCourse
            A part an hour; none where exact tables were deleted.
        """
        known = _with_tracks(records).values()
        if any(TRACKS.name in each.dropped for each in known):
            return []
        return [self._course(each, lane, span) for each in known]

    def _course(self, record: HourRecord, lane: int, span: Span) -> QueueCourse:
        begin = record.hour * STEPS_PER_HOUR
        first, after = max(begin, span[0]), min(begin + STEPS_PER_HOUR, span[1] + 1)
        grid = StepGrid(
            begin=first, steps=STEPS_PER_SECOND, count=max((after - first) // STEPS_PER_SECOND, 1)
        )
        stop = int(np.searchsorted(self.network.lane, lane))
        return queue_course(stop, self._lanes(record, grid))

    def exact(self, record: HourRecord) -> TrackedLanes:
        """Return the lanes of an hour, as one interval, with all vehicles on them.

        Raises
        ------
        InputError
            If its exact tables were deleted.
        """
        if TRACKS.name in record.dropped:
            raise InputError(
                "{}: {} has no exact tables any more, which headways and cycles are measured from",
                self.folder,
                hour_text(record.hour),
                hint="ask for a later time",
            )
        return self._lanes(record, _parts_of(record, STEPS_PER_HOUR))

    def _measure(
        self, record: HourRecord, steps: int, tile: Integers, interval: Integers,
        counts: Sequence[Any],
    ) -> Measured:  # fmt: skip
        visible, hidden, occupied, inferred, variance = (each.astype(np.float64) for each in counts)
        return measure_lanes(
            self._lanes(record, _parts_of(record, steps)),
            TileSteps(
                tile_id=tile, interval=interval.astype(np.int64), visible=visible,
                hidden=hidden, occupied=occupied, inferred=inferred, variance=variance,
            ),
        )  # fmt: skip

    def _lanes(self, record: HourRecord, grid: StepGrid) -> TrackedLanes:
        """Return the lanes over intervals of an hour, with all vehicles on them."""
        rows = record.read(self.folder, VEHICLES, ["vehicle", "length_m", "p_heavy", "p_exists"])
        return TrackedLanes(
            network=self.network, grid=grid, states=self._states(record),
            vehicles=VehicleTable(**{name: rows[name].to_numpy() for name in rows.column_names}),
            visible=self._runs(record, VISIBLE), observed=self._runs(record, OBSERVED),
        )  # fmt: skip

    def _runs(self, record: HourRecord, table: TableSchema) -> VisibleRuns:
        rows = record.read(self.folder, table, ["tile_id", "first_step", "last_step"])
        tile_id, first, last = (each.to_numpy() for each in rows.columns)
        return VisibleRuns(tile_id=tile_id, first=first, last=last)

    def _states(self, record: HourRecord) -> FrontStates:
        """Return the states of an hour, and those of the same vehicles in the hour before."""
        columns = ["vehicle", "step", "speed_cms", "lanelet_id", "s_cm", "seen"]
        rows = record.read(self.folder, TRACKS, columns)
        before = self._hour_before(record.hour)
        if before is not None and TRACKS.name not in before.dropped:
            pairs = record.read(self.folder, CONTINUED, CONTINUED.names)
            earlier = before.read(self.folder, TRACKS, columns)
            at = pc.index_in(earlier["vehicle"], pairs["vehicle"].combine_chunks())
            earlier = earlier.set_column(0, earlier.field(0), pairs["next"].take(at))
            earlier = earlier.filter(at.is_valid())
            rows = pa.concat_tables([earlier, rows])
            rows = rows.sort_by([("vehicle", "ascending"), ("step", "ascending")])
        known = rows["lanelet_id"].is_valid().to_numpy()
        lanelet = rows["lanelet_id"].fill_null(0).to_numpy()
        s_m = np.where(known, rows["s_cm"].fill_null(0).to_numpy() / 100.0, np.nan)
        lane, along = self.network.place(lanelet, s_m)
        return FrontStates(
            vehicle=rows["vehicle"].to_numpy(), step=rows["step"].to_numpy(), lane=lane,
            along_m=along, speed=rows["speed_cms"].to_numpy() / 100.0,
            seen=rows["seen"].to_numpy(),
        )  # fmt: skip


def _with_tracks(records: Mapping[int, HourRecord]) -> dict[int, HourRecord]:
    return {hour: each for hour, each in records.items() if TRACKS.name in each.parts}


def _parts_of(record: HourRecord, steps: int) -> StepGrid:
    """Return an hour in intervals of a number of steps."""
    begin = record.hour * STEPS_PER_HOUR
    return StepGrid(begin=begin, steps=steps, count=STEPS_PER_HOUR // steps)


def _arrow_tables(found: Measured, first: int) -> tuple[pa.Table, pa.Table]:
    lanes, turns = (
        table.to_arrow(values | {"interval": values["interval"] + first})
        for table, values in zip(LaneTraffic.tables, found, strict=True)
    )
    return lanes, turns


def day_makers(folder: Path, fingerprint: str) -> tuple[TileCounts, LaneTraffic]:
    """Return the makers and readers of all tables of dates of a dataset."""
    return (
        TileCounts(folder=folder, fingerprint=fingerprint),
        LaneTraffic(folder=folder, fingerprint=fingerprint),
    )


def maker_of(table: TableSchema, folder: Path, fingerprint: str) -> DayTables:
    """Return the maker and reader of a table of dates."""
    makers = day_makers(folder, fingerprint)
    return next(each for each in makers if table in each.tables)
