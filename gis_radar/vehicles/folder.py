"""Read and write the folder of vehicles.

Finished vehicles come piece by piece in ascending time, and are written as they come: memory is
that of a piece and of a block of runs, not of the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.errors import InputError
from gis_radar.files import whole_folder
from gis_radar.notebooks import card
from gis_radar.occupancy.folder import frames_table
from gis_radar.occupancy.frame_steps import Runs, covered_until, steps_in
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import iso_from_step
from gis_radar.tiles.tiles import fingerprint
from gis_radar.vehicles.coverage import CoverageEngine
from gis_radar.vehicles.coverage_settings import CoverageSettings
from gis_radar.vehicles.provenance import MANIFEST, Provenance, read_manifest, write_manifest
from gis_radar.vehicles.tables import (
    BLOCK_STEPS,
    COVERED,
    FRAMES,
    PASSAGES,
    TRACKS,
    VEHICLES,
    VISIBLE,
    TableKind,
    TableWriter,
    check_file,
    read_pieces,
    read_whole,
)
from gis_radar.vehicles.visibility import SensorView

Span: TypeAlias = tuple[int, int] | None
DRIVEN = "driven.parquet"  # of an hour of a site: where sensors see vehicles drive
_TABLES = (TRACKS, VEHICLES, PASSAGES, COVERED, VISIBLE, FRAMES)
OWNED = (MANIFEST, *(kind.file for kind in _TABLES), DRIVEN)


@dataclass(frozen=True, kw_only=True)
class VehiclePiece:
    """Finished vehicles of a span of steps, as a tracker hands them on.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive; after that of the piece before. The last piece ends with a frame.
    tracks : DataFrame
        The columns of `TRACKS`, by step and vehicle: all states in the span, one for each step from
        a vehicle's first to its last. `easting` and `northing` are the middle of the rectangle of
        its length and width: the middle of its front lies half a length ahead along `heading`, of
        vehicles over 12 m too.
    vehicles : DataFrame
        The columns of `VEHICLES`: each vehicle with a state in the span, as known so far. It may
        go on in the next piece under the same number.
    frames : DataFrame
        `sensor, view, first_step, last_step`: runs of steps in the span with a frame.
    """

    first_step: int
    last_step: int
    tracks: pd.DataFrame
    vehicles: pd.DataFrame
    frames: pd.DataFrame


@dataclass(frozen=True, kw_only=True)
class RunBlock:
    """The runs of a block of time.

    Parameters
    ----------
    number : int
        Of the block: its steps are `number * BLOCK_STEPS` and on.
    covered, visible : DataFrame
        The columns of `COVERED` and `VISIBLE`, by tile and step.
    """

    number: int
    covered: pd.DataFrame
    visible: pd.DataFrame


@dataclass(frozen=True, kw_only=True)
class Vehicles:
    """Vehicles, and which tiles they covered while these were visible.

    Parameters
    ----------
    provenance : Provenance
        What they were made from.
    frames : DataFrame
        `sensor, view, first_step, last_step`: runs of steps with a frame.
    vehicles, passages : DataFrame
        A row a vehicle, and a row a passage.
    read_tracks : callable
        Takes the first and the last step, or None for all, and starts reading the rows of
        `tracks.parquet` around them, piece by piece; see :meth:`tracks`.
    blocks : callable
        Starts reading the runs of covered and visible tiles, block by block, ascending.
    place : str
        From where they were read, for messages.
    """

    provenance: Provenance
    frames: pd.DataFrame
    vehicles: pd.DataFrame
    passages: pd.DataFrame
    read_tracks: Callable[[Span], Iterator[pd.DataFrame]]
    blocks: Callable[[], Iterator[RunBlock]]
    place: str = "the vehicles"

    @property
    def sensors(self) -> list[str]:
        """The names of the sensors that delivered frames."""
        return sorted(map(str, self.frames["sensor"].unique()))

    def tracks(self, span: Span = None) -> Iterator[pd.DataFrame]:
        """Read the states of all vehicles by step and vehicle, piece by piece.

        Parameters
        ----------
        span : (int, int), optional
            First and last step; without it, all.
        """
        for rows in self.read_tracks(span):
            yield rows if span is None else rows[rows["step"].between(*span)]

    def covered_frames(self) -> Runs:
        """Return the steps that frames of any sensor cover, to the last step with a frame."""
        end = int(self.frames["last_step"].max()) if len(self.frames) else 0
        return steps_in(hold_frames(self.frames, self.provenance.hold_s, end))

    def figures(self) -> dict[str, Any]:
        """Return sensors, time span, and how many vehicles and passages there are."""
        known: dict[str, Any] = {"sensors": self.sensors}
        if len(self.frames):
            known["begin"] = iso_from_step(int(self.frames["first_step"].min()))
            known["end"] = iso_from_step(int(self.frames["last_step"].max()) + 1)
        heavy = int((self.vehicles["p_heavy"] >= 0.5).sum())
        counts = {"vehicles": len(self.vehicles), "heavy": heavy, "passages": len(self.passages)}
        return known | counts

    def __repr__(self) -> str:
        known = self.figures()
        return (
            f"Vehicles({known['vehicles']}, {known['heavy']} of them heavy, "
            f"{known['passages']} passages, by {', '.join(known['sensors']) or 'no sensor'})"
        )

    def _repr_html_(self) -> str:
        return card("Vehicles", self.figures())


def hold_frames(frames: pd.DataFrame, hold_s: dict[str, float], end: int) -> pd.DataFrame:
    """Return a table of frames with the runs of steps that they cover, none after `end`."""
    covered = [frames[:0]]
    for sensor, rows in frames.groupby("sensor", sort=True):
        last = rows["last_step"].to_numpy(np.int64)
        until = covered_until(last, steps_in(rows), hold_s[str(sensor)])
        covered.append(rows.assign(last_step=np.minimum(until, end)))
    return pd.concat(covered, ignore_index=True)


class VehiclesWriter:
    """A folder of vehicles that is written as finished pieces come; made by `write_vehicles`."""

    def __init__(
        self, part: Path, provenance: Provenance, engine: CoverageEngine, files: ExitStack
    ) -> None:
        self.folder, self._provenance, self._engine = part, provenance, engine
        self._reached: int | None = None
        self._last: dict[int, int] = {}  # last step of the vehicles of the piece before
        self._vehicles: dict[int, dict[str, Any]] = {}
        self._passages: list[pd.DataFrame] = []
        self._frames: list[pd.DataFrame] = []
        self._recent = FRAMES.empty()  # of them, those that may cover steps to come
        self._writers = {
            kind.name: files.enter_context(
                TableWriter(
                    kind, part / kind.file, provenance.fingerprint,
                    by_piece=kind in (COVERED, VISIBLE),
                )
            )
            for kind in (TRACKS, COVERED, VISIBLE)
        }  # fmt: skip

    def warm_up(self, piece: VehiclePiece) -> None:
        """Take a piece before the first one: what it hides and where it drives, not its states."""
        tracks, vehicles = TRACKS.typed(piece.tracks), VEHICLES.typed(piece.vehicles)
        self._recent = FRAMES.typed(piece.frames.sort_values(["sensor", "view", "first_step"]))
        self._advance(piece, tracks, vehicles)
        self._engine.flush()
        self._passages = []

    def add(self, piece: VehiclePiece) -> None:
        """Write a piece that follows those so far.

        Raises
        ------
        InputError
            If its tables are not in order, or it does not follow.
        """
        tracks, vehicles = TRACKS.typed(piece.tracks), VEHICLES.typed(piece.vehicles)
        frames = FRAMES.typed(piece.frames.sort_values(["sensor", "view", "first_step"]))
        self._refuse_disorder(piece, tracks, vehicles)
        if self._reached is not None and piece.first_step // BLOCK_STEPS != self._block:
            self._flush()
        self._writers["tracks"].add(tracks)
        for row in vehicles.to_dict("records"):
            number = int(row["vehicle"])
            self._vehicles[number] = joined_rows(
                self._vehicles.get(number), {str(name): each for name, each in row.items()}
            )
        self._frames.append(frames)
        self._recent = pd.concat([self._recent, frames], ignore_index=True)
        late = self._recent["last_step"] >= piece.first_step - BLOCK_STEPS
        self._recent = self._recent[late].reset_index(drop=True)
        self._advance(piece, tracks, vehicles)

    def _advance(self, piece: VehiclePiece, tracks: pd.DataFrame, vehicles: pd.DataFrame) -> None:
        """Go on to the end of a piece, and write the blocks of runs that end in it."""
        held = hold_frames(self._recent, self._provenance.hold_s, piece.last_step)
        edges = range(piece.first_step // BLOCK_STEPS + 1, piece.last_step // BLOCK_STEPS + 1)
        begins = [piece.first_step, *(edge * BLOCK_STEPS for edge in edges)]
        for begin, after in zip(begins, [*begins[1:], piece.last_step + 1], strict=True):
            if begin > piece.first_step:
                self._flush()
            step = tracks["step"].to_numpy(np.int64)
            low, high = np.searchsorted(step, [begin, after])
            states = tracks.iloc[low:high].reset_index(drop=True)
            self._passages.append(self._engine.advance(states, vehicles, held, (begin, after)))
            self._reached = after - 1

    @property
    def _block(self) -> int:
        return (self._reached or 0) // BLOCK_STEPS

    def _refuse_disorder(
        self, piece: VehiclePiece, tracks: pd.DataFrame, vehicles: pd.DataFrame
    ) -> None:
        """Refuse states out of the span, without size, or with steps left out."""
        if piece.first_step > piece.last_step or piece.first_step <= (self._reached or -(2**62)):
            raise InputError(
                f"tracks: a piece of steps {piece.first_step} to {piece.last_step} does not follow "
                f"step {self._reached}"
            )
        by_vehicle = tracks.groupby("vehicle")["step"].agg(["min", "max", "size"])
        if not set(by_vehicle.index) <= set(vehicles["vehicle"]):
            raise InputError("tracks: has states of a vehicle that the vehicles lack")
        for number, (first, last, count) in zip(
            by_vehicle.index.tolist(), by_vehicle.to_numpy().tolist(), strict=True
        ):
            before = self._last.get(number, first - 1)
            if first < piece.first_step or last > piece.last_step:
                raise InputError(f"tracks: vehicle {number} has states out of its piece")
            if count != last - first + 1 or (number in self._vehicles and before != first - 1):
                raise InputError(f"tracks: vehicle {number} lacks a step from {before} to {last}")
        self._last = dict(zip(by_vehicle.index.tolist(), by_vehicle["max"].tolist(), strict=True))

    def _flush(self) -> None:
        covered, visible = self._engine.flush()
        self._writers["covered"].add(COVERED.typed(covered))
        self._writers["visible"].add(VISIBLE.typed(visible))

    def name_sources(self, sources: list[dict[str, Any]]) -> None:
        """Say what was read, where that is known only at the end."""
        self._provenance = replace(self._provenance, sources=sources)

    def finish(self) -> None:
        """Write what is known only at the end: the last block, vehicles, passages, manifest."""
        self._flush()
        frames = frames_table(pd.concat([FRAMES.empty(), *self._frames], ignore_index=True))
        vehicles = pd.DataFrame([self._vehicles[n] for n in sorted(self._vehicles)])
        passages = pd.concat([PASSAGES.empty(), *self._passages], ignore_index=True)
        write_beside_tracks(
            self.folder, self._provenance, frames, vehicles if len(vehicles) else VEHICLES.empty(),
            passages.sort_values([*PASSAGES.order]),
        )  # fmt: skip


def write_beside_tracks(
    folder: Path, provenance: Provenance, frames: pd.DataFrame, vehicles: pd.DataFrame,
    passages: pd.DataFrame,
) -> None:  # fmt: skip
    """Write the small tables and the manifest into an open folder."""
    for kind, table in ((FRAMES, frames), (VEHICLES, vehicles), (PASSAGES, passages)):
        with TableWriter(kind, folder / kind.file, provenance.fingerprint) as writer:
            writer.add(kind.typed(table))
    write_manifest(folder, provenance)


def joined_rows(known: dict[str, Any] | None, row: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a vehicle that goes on: size as known best, lanelets of both."""
    if known is None:
        return row
    best = min((row, known), key=lambda each: float(each["length_sigma_m"]))
    before, after = known["lanelets"].tolist(), row["lanelets"].tolist()
    most = min(len(before), len(after))
    shared = max(n for n in range(most + 1) if before[len(before) - n :] == after[:n])
    return {
        **best,
        "first_step": min(known["first_step"], row["first_step"]),
        "last_step": max(known["last_step"], row["last_step"]),
        "lanelets": np.array([*before, *after[shared:]], np.int64),
        "continues": bool(known["continues"] or row["continues"]),
    }


@contextmanager
def write_vehicles(
    folder: str | Path,
    *,
    tiles: gpd.GeoDataFrame,
    views: Sequence[SensorView],
    provenance: Provenance,
    settings: CoverageSettings | None = None,
    reporter: Reporter = QUIET,
) -> Iterator[VehiclesWriter]:
    """Write a folder of vehicles, whole or not at all.

    Parameters
    ----------
    folder : str or Path
        Where; an earlier one there is replaced.
    tiles : GeoDataFrame
        All tiles.
    views : sequence of SensorView
        Where each sensor stood in each of its views, and the tiles that it had in sight.
    provenance : Provenance
        Written to the manifest; the settings of the coverage are added.
    settings : CoverageSettings, optional
        Of footprints and visibility.
    reporter : Reporter
        Receives a warning where the file system has no locks.

    Yields
    ------
    VehiclesWriter
        Takes the pieces in ascending time.

    Raises
    ------
    InputError
        If the tiles are not those of the provenance.
    """
    settings = settings or CoverageSettings()
    if (got := fingerprint(tiles)) != provenance.fingerprint:
        raise InputError(f"the tiles have the fingerprint {got}, not {provenance.fingerprint}")
    in_effect = {**provenance.settings, "coverage": asdict(settings)}
    provenance = replace(provenance, settings=in_effect)
    whole = whole_folder(Path(folder), owned=OWNED, reporter=reporter)
    with whole as part, ExitStack() as files:
        engine = CoverageEngine(tiles, views, settings)
        writer = VehiclesWriter(part, provenance, engine, files)
        yield writer
        writer.finish()


def read_vehicles(folder: str | Path) -> Vehicles:
    """Open a folder of vehicles; tracks and runs stay on disk.

    Raises
    ------
    InputError
        If a file is missing, damaged, or made from other tiles than the rest, or the folder
        follows other rules.
    """
    folder = Path(folder)
    provenance = read_manifest(folder, lead=TRACKS.file)
    for kind in _TABLES:
        check_file(kind, folder / kind.file, provenance.fingerprint)
    frames = read_whole(FRAMES, folder / FRAMES.file)
    if lacking := set(frames["sensor"]) - set(provenance.hold_s):
        raise InputError(f"{folder / MANIFEST}: damaged: has no frame hold of {min(lacking)}")
    return Vehicles(
        provenance=provenance,
        frames=frames,
        vehicles=read_whole(VEHICLES, folder / VEHICLES.file),
        passages=read_whole(PASSAGES, folder / PASSAGES.file),
        read_tracks=lambda span: read_pieces(TRACKS, folder / TRACKS.file, span),
        blocks=lambda: _read_blocks(folder),
        place=str(folder),
    )


def _read_blocks(folder: Path) -> Iterator[RunBlock]:
    """Read the runs of both tables side by side, block by block."""
    streams = [_numbered(kind, folder / kind.file) for kind in (COVERED, VISIBLE)]
    heads = [next(stream, None) for stream in streams]
    while any(head is not None for head in heads):
        number = min(head[0] for head in heads if head is not None)
        tables = []
        for index, kind in enumerate((COVERED, VISIBLE)):
            head = heads[index]
            mine = head is not None and head[0] == number
            tables.append(head[1] if head is not None and mine else kind.empty())
            heads[index] = next(streams[index], None) if mine else head
        yield RunBlock(number=number, covered=tables[0], visible=tables[1])


def _numbered(kind: TableKind, path: Path) -> Iterator[tuple[int, pd.DataFrame]]:
    """Read the row groups of a table of runs with the numbers of their blocks, which ascend."""
    last = None
    for rows in read_pieces(kind, path):
        blocks = np.unique(rows[["first_step", "last_step"]].to_numpy(np.int64) // BLOCK_STEPS)
        if len(blocks) != 1 or (last is not None and blocks[0] <= last):
            raise InputError(f"{path}: its runs are not ordered by blocks of {BLOCK_STEPS} steps")
        last = int(blocks[0])
        tile, first, end = rows[["tile_id", "first_step", "last_step"]].to_numpy(np.int64).T
        bad = (tile[1:] < tile[:-1]) | ((tile[1:] == tile[:-1]) & (first[1:] <= end[:-1]))
        if bad.any():
            where = int(tile[1:][bad][0])
            raise InputError(f"{path}: runs of tile {where} overlap or are out of order")
        yield last, rows
