"""Merge folders of vehicles over time: sums stay exact, vehicles over an edge become one."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import combinations, islice
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

from gis_radar.arrays import Floats, Integers
from gis_radar.errors import InputError, UsageError
from gis_radar.occupancy.folder import frames_table
from gis_radar.occupancy.frame_steps import common_steps
from gis_radar.steps import STEP_S, iso_from_step
from gis_radar.vehicles.folder import RunBlock, Span, Vehicles, joined_rows
from gis_radar.vehicles.tables import BLOCK_STEPS, PASSAGES, VEHICLES

AGAIN = "make them with the same recorders, poses, tiles, map, scan and settings"
JOINED_M = 2.0  # least distance of the middles of two vehicles: half a car's length, a lane's width


def merge_vehicles(parts: Sequence[Vehicles]) -> Vehicles:
    """Merge vehicles of several times of one site.

    The result does not depend on their order. Vehicles get new numbers; one that an edge cuts,
    where the next part begins with the next step, is joined with the one that stands where it would
    have gone. A middle of a lanelet that it passes between the two steps is no passage.

    Parameters
    ----------
    parts : sequence of Vehicles
        Of the same sensors, poses, tiles, map, sight and settings, without a common step.

    Raises
    ------
    InputError
        If they are not.
    UsageError
        If there are none.
    """
    if not parts:
        raise UsageError("no folder of vehicles to merge")
    if len(parts) == 1:
        return parts[0]
    _refuse_others(parts)
    return join_vehicles(parts)


def join_vehicles(parts: Sequence[Vehicles]) -> Vehicles:
    """Return vehicles of several times as one, without a look at what they were made from."""
    parts = sorted(parts, key=lambda part: edges_of(part)[0])
    numbers = _numbers(parts)
    passages = pd.concat(
        [_renumbered(p.passages, p, new) for p, new in zip(parts, numbers, strict=True)],
        ignore_index=True,
    )
    passages = passages.drop_duplicates(["vehicle", "lanelet_id"])
    sources = [source for part in parts for source in part.provenance.sources]
    return replace(
        parts[0],
        provenance=replace(parts[0].provenance, sources=sources),
        frames=frames_table(pd.concat([part.frames for part in parts], ignore_index=True)),
        vehicles=_joined_vehicles(parts, numbers),
        passages=PASSAGES.typed(passages.sort_values([*PASSAGES.order])),
        read_tracks=lambda span: _merged_tracks(parts, numbers, span),
        blocks=lambda: _merged_blocks(parts),
        place=" and ".join(part.place for part in parts),
    )


def _refuse_others(parts: Sequence[Vehicles]) -> None:
    """Refuse parts that differ in what they were made from, or that share a step."""
    first = parts[0]
    mine = asdict(first.provenance) | {"poses": first.provenance.poses, "sensors": first.sensors}
    names = {"fingerprint": "tiles", "map": "map", "hold_s": "frame hold", "sensors": "sensors"}
    for part in parts[1:]:
        other = asdict(part.provenance) | {"poses": part.provenance.poses, "sensors": part.sensors}
        for name in ("fingerprint", "map", "sensors", "poses", "sight", "hold_s", "settings"):
            if json.dumps(mine[name], sort_keys=True) != json.dumps(other[name], sort_keys=True):
                raise InputError(
                    f"{first.place} and {part.place} have different {names.get(name, name)}: they "
                    "do not merge",
                    hint=AGAIN,
                )
    for one, other_part in combinations(parts, 2):
        shared = common_steps(one.covered_frames(), other_part.covered_frames())
        if len(shared):
            raise InputError(
                f"{one.place} and {other_part.place} have steps in common, from "
                f"{iso_from_step(int(shared.first[0]))}: they do not merge",
                hint="vehicles merge over time only; give each time once",
            )


def edges_of(part: Vehicles) -> tuple[int, int]:
    """Return the first and the last step with a frame or a state.

    A part of a longer time ends with a whole step of a vehicle where the next one begins, whether
    there is a frame in it or not.
    """
    first, last = part.vehicles["first_step"], part.vehicles["last_step"]
    begin, end = int(part.frames["first_step"].min()), int(part.frames["last_step"].max())
    return min([begin, *first]), max([end, *last])


def _joined_vehicles(parts: Sequence[Vehicles], numbers: Sequence[Integers]) -> pd.DataFrame:
    """Return a row for each vehicle of all parts; what is joined goes on only at its outer ends."""
    rows: dict[int, dict[str, Any]] = {}
    begins = {edges_of(part)[0] for part in parts}
    for part, new in zip(parts, numbers, strict=True):
        end = edges_of(part)[1]
        for each in part.vehicles.assign(vehicle=new).to_dict("records"):
            row = {str(name): value for name, value in each.items()}
            known = rows.get(number := int(row["vehicle"]))
            rows[number] = joined_rows(known, row)
            if known is not None:
                begun = known["continues"] and known["first_step"] in begins
                goes_on = row["continues"] and row["last_step"] == end
                rows[number]["continues"] = bool(begun or goes_on)
    table = pd.DataFrame([rows[number] for number in sorted(rows)], columns=[*VEHICLES.columns])
    return VEHICLES.typed(table)


def _numbers(parts: Sequence[Vehicles]) -> list[Integers]:
    """Return the new numbers of the vehicles of each part, in the order of its table."""
    found: list[Integers] = []
    fresh = 0
    for place, part in enumerate(parts):
        new = np.full(len(part.vehicles), -1)
        if place:
            before = parts[place - 1]
            for mine, other in _joins(before, part):
                new[mine] = found[-1][other]
        unknown = new < 0
        new[unknown] = fresh + np.arange(np.count_nonzero(unknown))
        fresh += int(np.count_nonzero(unknown))
        found.append(new)
    return found


def _joins(before: Vehicles, part: Vehicles) -> Iterator[tuple[int, int]]:
    """Yield pairs of rows of the vehicles of a part and of the part before that are one vehicle."""
    end, begin = edges_of(before)[1], edges_of(part)[0]
    if begin != end + 1:
        return
    other = _cut_states(before, end, "last_step")
    mine = _cut_states(part, begin, "first_step")
    if len(mine) == 0 or len(other) == 0:
        return
    heading = np.radians(other["heading"].to_numpy(float))
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    expected = _places(other) + ahead * (other["speed"].to_numpy(float) * STEP_S)[:, None]
    apart = np.linalg.norm(_places(mine)[:, None] - expected[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(apart, JOINED_M))
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if apart[row, column] < JOINED_M:
            yield int(mine["row"].iloc[row]), int(other["row"].iloc[column])


def _places(states: pd.DataFrame) -> Floats:
    return states[["easting", "northing"]].to_numpy(np.float64)


def _cut_states(part: Vehicles, step: int, edge: str) -> pd.DataFrame:
    """Return the states of the vehicles that an edge cuts, with their rows among the vehicles."""
    table = part.vehicles.assign(row=np.arange(len(part.vehicles)))
    cut = table[table["continues"] & (table[edge] == step)][["vehicle", "row"]]
    states = [rows[rows["step"] == step] for rows in part.tracks((step, step))]
    return pd.concat(states, ignore_index=True).merge(cut, on="vehicle") if states else cut[:0]


def _renumbered(table: pd.DataFrame, part: Vehicles, new: Integers) -> pd.DataFrame:
    """Return a table of a part with the new numbers of its vehicles."""
    known = part.vehicles["vehicle"].to_numpy(np.int64)
    row = np.searchsorted(known, table["vehicle"].to_numpy(np.int64))
    return table.assign(vehicle=new[row] if len(new) else new)


@dataclass(kw_only=True)
class _Stream:
    """The rows of `tracks` of a part that were read and not yet taken."""

    pieces: Iterator[pd.DataFrame]
    rows: pd.DataFrame | None = None
    ended: bool = False

    def more(self) -> bool:
        """Read on until a step is surely complete; return whether anything is left."""
        while not self.ended and (self.rows is None or self.rows["step"].iloc[0] > self.reach):
            piece = next(self.pieces, None)
            self.ended = piece is None
            if piece is not None and len(piece):
                waiting = [] if self.rows is None else [self.rows]
                self.rows = pd.concat([*waiting, piece], ignore_index=True)
        return self.rows is not None

    @property
    def reach(self) -> int:
        """The last step of which nothing more can come."""
        return 0 if self.rows is None else int(self.rows["step"].iloc[-1]) - (not self.ended)

    def take(self, bound: int) -> pd.DataFrame | None:
        """Remove and return all rows up to and with a step."""
        if self.rows is None:
            return None
        cut = int(np.searchsorted(self.rows["step"].to_numpy(), bound, side="right"))
        taken, rest = self.rows.iloc[:cut], self.rows.iloc[cut:].reset_index(drop=True)
        self.rows = rest if len(rest) else None
        return taken


def _merged_tracks(
    parts: Sequence[Vehicles], numbers: Sequence[Integers], span: Span
) -> Iterator[pd.DataFrame]:
    """Read the tracks of all parts side by side, by step and vehicle."""
    waiting = [
        (edges_of(part)[0], _Stream(pieces=map(partial(_renumbered, part=part, new=new), rows)))
        for part, new in zip(parts, numbers, strict=True)
        for rows in [part.tracks(span)]
    ]
    begun: list[_Stream] = []  # a part is opened when its time has come: there may be hundreds
    while waiting or begun:
        if not begun:
            begun.append(waiting.pop(0)[1])
        begun = [stream for stream in begun if stream.more()]
        bound = min((stream.reach for stream in begun), default=0)
        if begun and waiting and waiting[0][0] <= bound:
            begun.append(waiting.pop(0)[1])
            continue
        taken = [rows for stream in begun if (rows := stream.take(bound)) is not None]
        if taken:
            yield pd.concat(taken).sort_values(["step", "vehicle"], ignore_index=True)


def _merged_blocks(parts: Sequence[Vehicles]) -> Iterator[RunBlock]:
    """Read the runs of all parts side by side, block by block, each part when its time has come."""
    waiting = [(edges_of(part)[0] // BLOCK_STEPS, part) for part in parts]
    heads: list[tuple[RunBlock, Iterator[RunBlock]]] = []
    while waiting or heads:
        number = min((head.number for head, _ in heads), default=waiting[0][0] if waiting else 0)
        while waiting and waiting[0][0] <= number:
            heads += _head(waiting.pop(0)[1].blocks())
        if not heads:
            continue
        number = min(head.number for head, _ in heads)
        mine = [head for head, _ in heads if head.number == number]
        tables = []
        for name in ("covered", "visible"):
            rows = pd.concat([getattr(head, name) for head in mine], ignore_index=True)
            tables.append(rows.sort_values(["tile_id", "first_step"], ignore_index=True))
        yield RunBlock(number=number, covered=tables[0], visible=tables[1])
        heads = [
            kept
            for head, rest in heads
            for kept in (_head(rest) if head.number == number else [(head, rest)])
        ]


def _head(blocks: Iterator[RunBlock]) -> list[tuple[RunBlock, Iterator[RunBlock]]]:
    """Return the next block with those behind it; nothing where there is none."""
    return [(block, blocks) for block in islice(blocks, 1)]
