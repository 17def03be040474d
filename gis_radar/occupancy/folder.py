"""Read, write and merge the folder of an occupancy.

A folder holds frames and hits in the step of their time; which further steps they cover follows on
reading, after merging. Rules 1, of version 0.1, held a frame for its stated cycle on writing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Integers
from gis_radar.errors import InputError, UsageError
from gis_radar.files import whole_folder
from gis_radar.json_documents import read_json
from gis_radar.notebooks import card
from gis_radar.occupancy.frame_log import COLUMNS, FILE, FRAME_LOG, merge_frame_logs
from gis_radar.occupancy.frame_steps import Runs, covered_until, hold_hits, steps_in
from gis_radar.occupancy.hits import (
    CHECKED,
    HITS,
    PAIRS,
    Rows,
    damaged_as_input_error,
    merge_rows,
)  # fmt: skip
from gis_radar.occupancy.settings import DEFAULTS
from gis_radar.occupancy.views import name_of_view
from gis_radar.poses.pose import pose_from_dict
from gis_radar.progress import QUIET, Reporter
from gis_radar.sight import VIEW_ONLY
from gis_radar.steps import FIRST_YEAR, LAST_YEAR, STEP_S, in_known_years, iso_from_step

RULES = 2
MANIFEST, HITS_FILE, PAIRS_FILE = "manifest.json", "hits_by_sensor.parquet", "hits.parquet"
OWNED = (  # a table made of it may stand there
    MANIFEST, "frames.parquet", "views.parquet", HITS_FILE, PAIRS_FILE, FILE, "quality.",
)  # fmt: skip
NEEDED = {
    PAIRS_FILE: ("step", "tile_id"),
    "frames.parquet": ("sensor", "first_step", "last_step"),
    "views.parquet": ("sensor", "tile_id"),
    FILE: COLUMNS,
}
MOST_HOLD_S = 90.0  # 1.5 cycles of the slowest sensor that may be stated, a frame a minute
MEASURE_AGAIN = "measure it again with: gis-radar occupancy"
NOTHING: Integers = np.empty(0, np.int64)
RowsOfSensors = Callable[[Sequence[str]], Iterator[Rows]]


@dataclass(frozen=True, kw_only=True)
class Occupancy:
    """Hits of tiles, and what could have been hit.

    Parameters
    ----------
    fingerprint : str
        Of its tiles.
    frames : DataFrame
        `sensor, view, first_step, last_step`: runs of steps in which a frame of the sensor falls
        while it had that view.
    views : DataFrame
        `sensor, tile_id, view, first_step, last_step`: the tiles each view sees, and from when
        to when the sensor had it. The name of a view stands for its set of tiles.
    hits_by_sensor : callable
        Takes the names of all sensors and starts reading the rows (step, tile_id, sensor), each
        once, ascending, piece by piece: the steps that frames fall in, sensors as numbers.
    sources : list of dict
        Per recording: file, sensor, poses, filters, settings.
    hold_s : dict
        By sensor, how long its frames hold, seconds.
    frame_log : callable
        Takes the names of all sensors and starts reading the rows of the frame log, as of
        :mod:`gis_radar.occupancy.frame_log`; none where the folder has no such log.
    rules : int
        By which it was made.
    place : str
        From where it was read, for messages.
    """

    fingerprint: str
    frames: pd.DataFrame
    views: pd.DataFrame
    hits_by_sensor: RowsOfSensors
    sources: list[dict[str, Any]]
    hold_s: dict[str, float]
    frame_log: RowsOfSensors = lambda _: iter(())
    rules: int = RULES
    place: str = "the occupancy"

    @property
    def sensors(self) -> list[str]:
        """The names of the sensors that delivered frames."""
        return sorted(map(str, self.frames["sensor"].unique()))

    def __repr__(self) -> str:
        seconds = ", ".join(f"{sensor} {text}" for sensor, text in self._covered().items())
        tiles = self.views["tile_id"].nunique()
        return f"Occupancy({seconds} covered by frames, {tiles} tiles seen)"

    def hits(self) -> Iterator[Rows]:
        """Read the pairs (step, tile_id) in the steps that frames fall in, each once, ascending."""
        return merge_rows([(rows[:2] for rows in self.hits_by_sensor(self.sensors))], 2)

    def held_hits(self) -> Iterator[Rows]:
        """Read the pairs (step, tile_id) in all steps that frames cover, each once, ascending."""
        by_sensor = self.frames.groupby("sensor", sort=True)
        frames = [(steps_in(rows), self.hold_s[str(name)]) for name, rows in by_sensor]
        return hold_hits(self.hits_by_sensor(self.sensors), frames)

    def covered_frames(self) -> pd.DataFrame:
        """Return `frames` with the runs of steps that they cover, to the last step with a frame."""
        covered, end = [self.frames[:0]], self.frames["last_step"].max()
        for sensor, rows in self.frames.groupby("sensor", sort=True):
            last = rows["last_step"].to_numpy(np.int64)
            until = covered_until(last, steps_in(rows), self.hold_s[str(sensor)])
            covered.append(rows.assign(last_step=np.minimum(until, end)))
        return pd.concat(covered, ignore_index=True)

    def _covered(self) -> dict[str, str]:
        runs = self.covered_frames().groupby("sensor")
        return {str(sensor): f"{steps_in(rows).steps * STEP_S:.1f} s" for sensor, rows in runs}

    def figures(self) -> dict[str, Any]:
        """Return sensors, time span, tiles and hits."""
        return self._span() | {"hits": sum(len(step) for step, _ in self.hits())}

    def _span(self) -> dict[str, Any]:
        first, last = int(self.frames["first_step"].min()), int(self.frames["last_step"].max())
        return {
            "sensors": self.sensors,
            "begin": iso_from_step(first),
            "end": iso_from_step(last + 1),
            "tiles_observed": int(self.views["tile_id"].nunique()),
            "sight": self.sight,
        }

    @property
    def sight(self) -> str:
        """Whether what stands in a scan hides tiles: `view only` where that is not so of all."""
        scanned = [isinstance(source.get("sight"), dict) for source in self.sources]
        return "with a scan" if scanned and all(scanned) else VIEW_ONLY

    def _repr_html_(self) -> str:
        if self.frames.empty:
            return card("Occupancy", {"frames": "none"})
        return card("Occupancy", {**self._span(), "covered by frames": self._covered()})

    def write(self, folder: str | Path, *, pairs: bool = False) -> Path:
        """Write the folder, whole or not at all; equal content gives equal files.

        Parameters
        ----------
        folder : str or Path
            Where.
        pairs : bool
            Also write `hits.parquet`, for other programs: the pairs of :meth:`hits`.

        Raises
        ------
        InputError
            If it was made by older rules.
        """
        if self.rules != RULES:
            raise InputError(f"{self.place}: follows rules {self.rules}", hint=MEASURE_AGAIN)
        folder = Path(folder)
        with whole_folder(folder, owned=OWNED) as part:
            rows = self.hits_by_sensor(self.sensors)
            HITS.write(rows, part / HITS_FILE, self.fingerprint, self.sensors)
            self.write_beside_hits(part, pairs=pairs)
        return folder

    def write_beside_hits(self, folder: Path, *, pairs: bool) -> None:
        """Write everything but the hits by sensor into an open folder."""
        if pairs:
            PAIRS.write(self.hits(), folder / PAIRS_FILE, self.fingerprint)
        for name, table in (("frames", self.frames), ("views", self.views)):
            pq.write_table(
                pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(
                    {"fingerprint": self.fingerprint}
                ),
                folder / f"{name}.parquet",
                compression="zstd",
                write_page_checksum=True,
            )
        rows = self.frame_log(self.sensors)
        FRAME_LOG.write(rows, folder / FILE, self.fingerprint, self.sensors)
        manifest = {
            "fingerprint": self.fingerprint,
            "software": {"name": "gis_radar", "version": version("gis_radar")},
            "rules": RULES,
            "hold_s": self.hold_s,
            "sources": _ordered(self.sources),
        }
        text = json.dumps(manifest, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
        (folder / MANIFEST).write_text(text, encoding="utf-8")


def frames_of(sensor: object, view: object, steps: Runs) -> pd.DataFrame:
    """Return the rows of the table of frames for one sensor and view."""
    return pd.DataFrame(
        {"sensor": sensor, "view": view, "first_step": steps.first, "last_step": steps.last}
    )


def frames_table(frames: pd.DataFrame) -> pd.DataFrame:
    """Return a table of frames in its one form: fewest runs, ordered by sensor, view and step."""
    empty = frames_of("", "", steps_in(frames[:0]))
    groups = frames.groupby(["sensor", "view"], sort=True)
    pieces = [frames_of(sensor, view, steps_in(rows)) for (sensor, view), rows in groups]
    return _typed(pd.concat(pieces, ignore_index=True) if pieces else empty)


def views_table(frames: pd.DataFrame, tiles: dict[str, Integers]) -> pd.DataFrame:
    """Return the table of views: each tile that a view sees, and the steps it held.

    Parameters
    ----------
    frames : DataFrame
        The table of frames: which sensor had which view in which steps.
    tiles : dict
        Ids of the tiles of each view; a view that is not there sees none.
    """
    held = frames.groupby(["sensor", "view"], sort=True, as_index=False).agg(
        first_step=("first_step", "min"), last_step=("last_step", "max")
    )
    seen = [np.sort(tiles.get(view, NOTHING)) for view in held["view"]]
    row = np.repeat(np.arange(len(seen)), np.array([len(ids) for ids in seen], np.int64))
    table = held.iloc[row].reset_index(drop=True)
    table.insert(1, "tile_id", np.concatenate([NOTHING, *seen]))
    return _typed(table)


def _typed(table: pd.DataFrame) -> pd.DataFrame:
    return table.astype({n: str if n in ("sensor", "view") else np.int64 for n in table.columns})


def read_occupancy(
    folder: str | Path | Sequence[str | Path], *, reporter: Reporter = QUIET
) -> Occupancy:
    """Open an occupancy folder, or several as one; hits stay on disk.

    Parameters
    ----------
    folder : str or Path, or a sequence of them
        As made by :func:`gis_radar.measure_occupancy`; several are merged, as
        :func:`gis_radar.merge_occupancies` does.
    reporter : Reporter
        Receives a warning where the folder was made by older rules.

    Raises
    ------
    InputError
        If a file is missing, damaged, or made from other tiles than the rest, or the folder follows
        rules that are not known here.
    """
    if not isinstance(folder, str | Path):
        if not folder:
            raise UsageError("there is no occupancy folder to read")
        return merge_occupancies([read_occupancy(each, reporter=reporter) for each in folder])
    folder = Path(folder)
    manifest = _read_manifest(folder)
    fingerprint, rules = manifest["fingerprint"], manifest["rules"]
    frames, views = (
        _read_table(folder, f"{name}.parquet", fingerprint) for name in ("frames", "views")
    )
    hits, log = folder / (HITS_FILE if rules == RULES else PAIRS_FILE), folder / FILE
    for path in (hits, log) if log.exists() else (hits,):
        _check_table(path, fingerprint)
    frames, views = _with_view_names(frames, views)
    hold_s = DEFAULTS.hold_s if rules == RULES else 0.0
    manifest["hold_s"] = dict.fromkeys(frames["sensor"].unique(), hold_s) | manifest["hold_s"]
    if rules != RULES:
        reporter.log(
            f"{folder}: follows rules {rules}, not {RULES}: its frames cover no more than their "
            f"own step or a stated cycle; {MEASURE_AGAIN}",
            "warning",
        )
    return Occupancy(
        frames=frames,
        views=views,
        hits_by_sensor=lambda names: (
            HITS.read(hits, names)
            if rules == RULES
            else ((*rows, np.zeros_like(rows[0])) for rows in PAIRS.read(hits))
        ),
        frame_log=lambda names: FRAME_LOG.read(log, names) if log.is_file() else iter(()),
        place=str(folder),
        **manifest,
    )


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Return what the manifest holds, by the names of the fields of an Occupancy."""
    _require(folder / MANIFEST)
    manifest = read_json(folder / MANIFEST, what="a manifest of an occupancy")
    try:
        found: dict[str, Any] = {
            "fingerprint": str(manifest["fingerprint"]),
            "sources": list(manifest["sources"]),
            "rules": int(manifest.get("rules", 1)),
            "hold_s": {str(name): float(s) for name, s in manifest.get("hold_s", {}).items()},
        }
        _check_sources(found["sources"], str(folder / MANIFEST))
        odd = [name for name, s in found["hold_s"].items() if not 0.0 <= s <= MOST_HOLD_S]
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(f"{folder / MANIFEST}: damaged: {error!r:.200}") from error
    if odd:
        hold_s = found["hold_s"][odd[0]]
        raise InputError(f"{folder / MANIFEST}: damaged: frames of {odd[0]} hold {hold_s:g} s")
    if not 1 <= found["rules"] <= RULES:
        raise InputError(
            f"{folder}: follows rules {found['rules']}, expected {RULES} or less",
            hint="it was made by a newer gis_radar",
        )
    return found


def _check_sources(sources: list[Any], what: str) -> None:
    """Refuse entries of recordings that are not what is written; what reads them relies on it."""
    for source in sources:
        poses = source.get("poses", [])
        if not isinstance(source["sensor"], str) or not isinstance(poses, list):
            raise TypeError("a source names no sensor, or lists no poses")
        for pose in poses:
            pose_from_dict(dict(pose), what=what)
        for name in ("filters", "settings", "clock"):
            if not isinstance(source.get(name, {}), dict | None):
                raise TypeError(f"{name} of {source['sensor']:.40} are no table")


def _require(path: Path) -> None:
    if not path.is_file():
        raise InputError(
            f"{path.parent}: not an occupancy folder: lacks {path.name}",
            hint="make one with: gis-radar occupancy",
        )


def _read_table(folder: Path, name: str, fingerprint: str) -> pd.DataFrame:
    path = folder / name
    _check_table(path, fingerprint)
    with damaged_as_input_error(path):
        table = pd.DataFrame(pq.read_table(path, **CHECKED).to_pandas())
    if {"first_step", "last_step"} <= set(table) and (table.first_step > table.last_step).any():
        raise InputError(f"{path}: damaged: steps that end before they begin")
    if table.isna().to_numpy().any():
        raise InputError(f"{path}: damaged: a value is missing")
    for column in {"first_step", "last_step"} & set(table):
        if not in_known_years(table[column].to_numpy(np.float64) * STEP_S).all():
            raise InputError(
                f"{path}: damaged: steps outside the years {FIRST_YEAR} to {LAST_YEAR}"
            )
    return table


def _check_table(path: Path, fingerprint: str) -> None:
    """Refuse a table that is missing, lacks columns or was made from other tiles."""
    _require(path)
    with damaged_as_input_error(path):
        schema = pq.read_schema(path)
    hits = path.name == HITS_FILE
    needed = HITS.columns(schema.names) if hits else NEEDED[path.name]
    missing = [column for column in needed if column not in schema.names]
    if missing:
        raise InputError(f"{path}: lacks the column {missing[0]}")
    for column in {"step", "tile_id", "first_step", "last_step"} & set(schema.names):
        if not pa.types.is_integer(kind := schema.field(column).type):
            raise InputError(f"{path}: column {column} is {kind}, expected whole numbers")
    for column in {"sensor", "view"} & set(schema.names):
        if not _is_text(kind := schema.field(column).type):
            raise InputError(f"{path}: column {column} is {kind}, expected text")
    if "tiles" in needed and not pa.types.is_binary(kind := schema.field("tiles").type):
        raise InputError(f"{path}: column tiles is {kind}, expected bytes")
    other = (
        (schema.metadata or {}).get(b"fingerprint", fingerprint.encode()).decode(errors="replace")
    )
    if other != fingerprint:
        raise InputError(f"{path}: was made from tiles {other}, its folder from {fingerprint}")


def _is_text(kind: pa.DataType) -> bool:
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _with_view_names(
    frames: pd.DataFrame, views: pd.DataFrame
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Name the views of tables that have none: one a sensor."""
    if "view" in frames and "view" in views:
        return frames, views
    seen = views.groupby("sensor")["tile_id"]
    names = {sensor: name_of_view(tiles.to_numpy(np.int64)) for sensor, tiles in seen}
    named = frames.assign(view=frames["sensor"].map(names).fillna(name_of_view(NOTHING)))
    tiles = {names[sensor]: ids.to_numpy(np.int64) for sensor, ids in seen}
    return named, views_table(named, tiles)


def merge_occupancies(parts: Sequence[Occupancy]) -> Occupancy:
    """Merge occupancies of any times and sensors, exactly.

    The result does not depend on their order, on how the time was split between them, or on
    repetition: each table is a set, and its one written form follows from its content.

    Raises
    ------
    InputError
        If their tiles differ, their rules, or how long the frames of a sensor hold.
    """
    if len({part.fingerprint for part in parts}) > 1:
        raise InputError("the occupancy folders were made with different tiles")
    _refuse_other_rules(parts)
    frames = frames_table(pd.concat([part.frames for part in parts]))
    pairs = pd.concat([part.views[["view", "tile_id"]] for part in parts]).drop_duplicates()
    tiles = {
        str(view): group.to_numpy(np.int64) for view, group in pairs.groupby("view")["tile_id"]
    }
    return Occupancy(
        fingerprint=parts[0].fingerprint,
        frames=frames,
        views=views_table(frames, tiles),
        hits_by_sensor=lambda names: merge_rows([part.hits_by_sensor(names) for part in parts], 3),
        sources=_ordered([source for part in parts for source in part.sources]),
        frame_log=lambda names: merge_frame_logs([part.frame_log(names) for part in parts]),
        hold_s={sensor: hold_s for part in parts for sensor, hold_s in part.hold_s.items()},
        rules=parts[0].rules,
    )


def _refuse_other_rules(parts: Sequence[Occupancy]) -> None:
    """Refuse parts of different rules, or in which the frames of a sensor hold differently."""
    older, newer = (choose(parts, key=lambda part: part.rules) for choose in (min, max))
    if older.rules != newer.rules:
        raise InputError(
            f"{older.place}: follows rules {older.rules}, {newer.place} rules {newer.rules}: "
            "they do not merge",
            hint=MEASURE_AGAIN,
        )
    known: dict[str, tuple[float, Occupancy]] = {}
    for part in parts:
        for sensor, hold_s in part.hold_s.items():
            other_s, other = known.setdefault(sensor, (hold_s, part))
            if hold_s != other_s:
                raise InputError(
                    f"{part.place}: frames of {sensor} hold {1000 * hold_s:g} ms, in "
                    f"{other.place} {1000 * other_s:g} ms: they do not merge",
                    hint="measure the parts of a sensor with the same --cycle, or all without",
                )


def _ordered(sources: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return each source once, in an order that follows from the sources alone."""
    texts = {json.dumps(source, sort_keys=True) for source in sources}
    return [json.loads(text) for text in sorted(texts)]
