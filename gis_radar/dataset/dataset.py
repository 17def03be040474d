"""A dataset as one object, whose tables are read when they are needed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import (
    QUIET,
    Integers,
    Reporter,
    Text,
    UsageError,
    card,
    checked_methods,
    iso_from_time,
)
from gis_radar.dataset.days.lane_measures import day_makers, maker_of
from gis_radar.dataset.files import STATED_LANES, frame_times, tables
from gis_radar.dataset.files.manifest import Manifest, refuse_other_map
from gis_radar.dataset.files.parts import hour_begin, hour_text
from gis_radar.dataset.files.records import Span, hour_bounds, read_hour, read_rows
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.source import DatasetFiles, Moment
from gis_radar.dataset.files.stated_lanes import stated_lanes, streets_of, write_stated
from gis_radar.dataset.hours import upkeep
from gis_radar.dataset.questions import profiles
from gis_radar.dataset.questions.answers import SqlQueries
from gis_radar.dataset.traffic import headways_cycles, sections
from gis_radar.dataset.traffic import tables as traffic_tables
from gis_radar.dataset.vehicles import footprints, states
from gis_radar.hdmap import LANES_LAYER, STOP_LINES_LAYER, TILES_LAYER


@checked_methods
@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset(DatasetFiles, SqlQueries):
    """Dataset of a site: tables by hour, read when they are asked for.

    Tables come in metres, degrees, m/s and UTC timestamps; `begin` is included, `end` is not.
    A time without a zone is by the clocks of the site.

    Parameters
    ----------
    folder : Path
        The dataset's folder.
    manifest : Manifest
        Its map, tiles, coordinate system and settings.
    cache : dict
        Results that several questions need, by key; filled by them.
    """

    lane_months = profiles.lane_months
    tile_months = profiles.tile_months
    profile = profiles.profile
    withdraw = upkeep.withdraw
    keep = upkeep.keep
    relink = upkeep.relink
    frame_steps = frame_times.frame_steps
    traffic = traffic_tables.traffic
    turns = traffic_tables.turns
    queues = traffic_tables.queues
    count_sections = sections.count_sections
    signal_cycles = headways_cycles.signal_cycles
    track_points = states.track_points
    to_trajectories = states.to_trajectories
    write_footprints = footprints.write_footprints

    @property
    def sensors(self) -> list[str]:
        """Names of the sensors with recordings."""
        return sorted(set(self.single_table(tables.RECORDINGS)["sensor"].to_pylist()))

    @property
    def doubts(self) -> list[str]:
        """One line for each sensor whose pose and recordings are not known to fit."""
        known = self.manifest.doubts
        return [known[sensor] for sensor in self.sensors if sensor in known]

    @property
    def methods(self) -> list[int]:
        """Methods by which its hours were made; results of different methods do not compare."""
        return sorted({each.origin.method for each in self.records().values()})

    def queried_sites(self) -> tuple[Path, Mapping[str, Dataset]]:
        """Return the folder, and the dataset under an empty name."""
        return self.folder, {"": self}

    def batches(
        self, table: TableSchema, span: Span | None = None, columns: Sequence[str] | None = None
    ) -> Iterator[pa.Table]:
        """Read the rows of a table with the columns of the files, an hour (or date) at a time.

        Parameters
        ----------
        table : TableSchema
            A table of hours, or of dates: tile counts, lane measures and turns. The latter get a
            further column `first_step`, in which the interval begins.
        span : (int, int), optional
            First and last step of the rows. Runs of tiles are cut to it; of tables of dates,
            intervals that begin in it are read.
        columns : sequence of str, optional
            Names of the columns; by default all.
        """
        records = self.records(span)
        if table in tables.DAY_TABLES:
            maker = maker_of(table, self.folder, self.manifest.fingerprint)
            return maker.read(table, records, span, columns)
        return read_rows(self.folder, table, records, span, columns)

    def tiles(self) -> gpd.GeoDataFrame:
        """Read the tiles.

        Raises
        ------
        InputError
            If they are not those that the dataset was made from.
        """
        return self.layer(TILES_LAYER)

    def lanes(self) -> gpd.GeoDataFrame:
        """Read the lanes."""
        return self.layer(LANES_LAYER)

    def stop_lines(self) -> gpd.GeoDataFrame:
        """Read the stop lines."""
        return self.layer(STOP_LINES_LAYER)

    def recordings(self) -> pd.DataFrame:
        """Read the table of recordings from which it was made."""
        return self._read_single(tables.RECORDINGS)

    def last_poses(self) -> gpd.GeoDataFrame:
        """Return for each sensor the pose by which its last recording was measured.

        Returns
        -------
        GeoDataFrame
            Rows of :meth:`poses`, by sensor.
        """
        used = self.recordings().groupby("pose")["end"].max()
        poses = self.poses()
        order = poses.assign(used=used.reindex(poses["track"]).array).sort_values(
            ["sensor", "used", "since"], na_position="first"
        )
        return poses.loc[order.drop_duplicates("sensor", keep="last").index]

    def sight_of(self, sensor: str) -> Integers:
        """Return the ids of the tiles in sight of the last pose of a sensor.

        Raises
        ------
        UsageError
            If it has no such sensor.
        """
        sight = self.last_poses().set_index("sensor")["sight"]
        if sensor not in sight:
            raise UsageError("{}: has no sensor {}", self.folder, repr(sensor),
                             hint=Text("it has {}", ", ".join(self.sensors)))  # fmt: skip
        pairs = self.sights()
        return np.asarray(pairs.loc[pairs["pose"] == sight[sensor], "tile_id"], np.int64)

    def hours(self) -> pd.DataFrame:
        """Return the complete hours, with the number of rows of each table."""
        rows = [
            {"begin": pd.Timestamp(hour_begin(hour)), "method": record.origin.method}
            | {name: part.rows for name, part in record.parts.items()}
            for hour, record in self.records().items()
        ]
        return pd.DataFrame(rows, columns=None if rows else ["begin", "method"])

    def hits(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the hits: tile, and time of the step in which it was hit."""
        return self._read(tables.HITS, begin, end)

    def observed(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the runs of time in which tiles were observed."""
        return self._read(tables.OBSERVED, begin, end)

    def visible(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the runs of time in which tiles were visible."""
        return self._read(tables.VISIBLE, begin, end)

    def occupied(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the runs of time in which tiles were occupied, visible or not."""
        return self._read(tables.OCCUPIED, begin, end)

    def tracks(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the states of vehicles: every 0.2 s, and at a vehicle's first and last step."""
        return self._read(tables.TRACKS, begin, end)

    def vehicles(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the vehicles."""
        return self._read(tables.VEHICLES, begin, end)

    def passages(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the passages of vehicles over the middles of lanelets."""
        return self._read(tables.PASSAGES, begin, end)

    def frames(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the frames of the sensors, a row for each frame."""
        return self._read(tables.FRAMES, begin, end)

    def tile_counts(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the counts by tile and quarter of an hour, which begins at `begin`."""
        return self._read(tables.TILE_COUNTS, begin, end)

    def lane_measures(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the measures of lanes by quarter of an hour as they are stored, in m/s."""
        return self._read(tables.LANE_MEASURES, begin, end)

    def turn_volumes(self, *, begin: Moment = None, end: Moment = None) -> pd.DataFrame:
        """Read the volumes of turns by quarter of an hour as they are stored."""
        return self._read(tables.TURNS, begin, end)

    def check(self, reporter: Reporter = QUIET) -> None:
        """Compare the bytes of all parts with the records of their hours; read all other files.

        Raises
        ------
        InputError
            On the first file that differs.
        """
        records = self.records()
        refuse_other_map(self.folder, self.manifest)
        fresh, stated = replace(self, _layers={}), (self.folder / STATED_LANES).is_file()
        for read in (fresh.poses, fresh.sights, fresh.lanes if stated else fresh.tiles):
            read()
        for done, record in enumerate(records.values()):
            for name in sorted(record.parts.keys() - set(record.dropped)):
                record.check_bytes(self.folder, tables.TABLES[name])
            reporter.progress("checking parts", done + 1, len(records))
        for maker in day_makers(self.folder, self.manifest.fingerprint):
            maker.check(records)
        profiles.roll_ups(self).check()

    def figures(self) -> dict[str, Any]:
        """Return sensors, recordings, time span, hours and numbers of rows of the tables."""
        records = self.records()
        recordings = self.recordings()
        figures: dict[str, Any] = {
            "sensors": self.sensors,
            "recordings": sorted({Path(path).name for path in recordings["path"]}),
        }
        if len(recordings):
            figures |= {
                "first_frame": iso_from_time(recordings["begin"].min()),
                "last_frame": iso_from_time(recordings["end"].max()),
            }
        figures["hours"] = len(records)
        if records:
            figures |= {"begin": hour_text(min(records)), "end": hour_text(max(records) + 1)}
        for table in tables.HOUR_TABLES:
            parts = [r.parts[table.name] for r in records.values() if table.name in r.parts]
            if parts:
                figures[table.name] = sum(part.rows for part in parts)
        if dropped_hours := [hour for hour, each in records.items() if each.dropped]:
            figures["hours_without_exact_tables"] = len(dropped_hours)
            figures["exact_tables_from"] = hour_text(max(dropped_hours) + 1)
        if len(self.methods) > 1:
            figures["methods"] = self.methods
        if self.doubts:
            figures["not_known_to_fit"] = self.doubts
        return figures

    def __repr__(self) -> str:
        figures = self.figures()
        names = ", ".join(figures["sensors"]) or "no sensors"
        hours = f"{figures['hours']} hour{'s' if figures['hours'] != 1 else ''}"
        when = f", {figures['begin']} to {figures['end']}" if figures["hours"] else ""
        counted = (
            table.name
            for table in (tables.HITS, tables.VEHICLES, tables.PASSAGES)
            if table.name in figures
        )
        rows = "".join(f", {figures[name]} {name}" for name in counted)
        return f"Dataset({str(self.folder)!r}: {names}, {hours}{when}{rows})"

    def _repr_html_(self) -> str:
        return card("Dataset", {"folder": str(self.folder), **self.figures()})

    def with_lanes(
        self, lanes: Sequence[Mapping[str, Any]], speed_kmh: float | None = None
    ) -> Dataset:
        """Return the dataset with names and free speeds of lanes as stated; nothing is written.

        Parameters
        ----------
        lanes : sequence of mapping
            For each lane its number `id`, and what is stated of it: `name`, `speed_kmh`, `street`,
            `street_part`; the dataset's own, or the map's, where that is None or missing.
        speed_kmh : float, optional
            Free speed of lanes that have none.

        Raises
        ------
        InputError
            If a lane is none of the dataset's.
        """
        if not lanes and speed_kmh is None:
            return self
        layer = stated_lanes(self.layer(LANES_LAYER), lanes, speed_kmh, self.folder)
        return replace(self, cache={}, _layers={**self._layers, LANES_LAYER: layer})

    def state_lanes(
        self, lanes: Sequence[Mapping[str, Any]] = (), speed_kmh: float | None = None, *,
        streets: str | Path | pd.DataFrame | None = None, reporter: Reporter = QUIET,
    ) -> Dataset:  # fmt: skip
        """Write names and free speeds of lanes into the dataset, in place of those it has.

        Hours stay as they are. Returns the dataset with them.

        Parameters
        ----------
        lanes, speed_kmh
            As for :meth:`with_lanes`. Lanes that the dataset has not are left out.
        streets : str, Path or DataFrame, optional
            File of tiles whose lanes have streets, from `gis-radar tiles --streets`, or lanes, as
            from :meth:`gis_radar.LaneletMap.lanes`; those of :meth:`lanes` keep their streets.
        reporter : Reporter
            Receives a warning about lanes that are left out.
        """
        of_map, stated = self._other_layer(LANES_LAYER), dict[Any, dict[str, Any]]()
        for each in (*(() if streets is None else streets_of(streets, of_map)), *lanes):
            given = {key: value for key, value in each.items() if value is not None}
            stated.setdefault(each.get("id"), {}).update(given)
        known = set(of_map["lane"].tolist())
        if unknown := [str(each) for each in stated if each not in known]:
            reporter.warn(
                "the site file names lanes that the map has not: {}; they are left out",
                ", ".join(unknown),
            )
        kept = [each for lane, each in stated.items() if lane in known]
        stated_lanes(of_map, kept, speed_kmh, self.folder)  # refuses what is no statement
        write_stated(self.folder, kept, speed_kmh)
        return open_dataset(self.folder)


def open_dataset(path: str | Path | Dataset, *, reporter: Reporter = QUIET) -> Dataset:
    """Open a dataset; its tables are read when they are asked for.

    Parameters
    ----------
    path : str, Path or Dataset
        The folder that `measure`, `run` or `live` made; an open dataset stays as it is.
    reporter : Reporter
        Receives a warning where hours were made by different methods.

    Raises
    ------
    InputError
        If the folder is no dataset, or has a newer schema.
    """
    if isinstance(path, Dataset):
        return path
    dataset = Dataset(folder=Path(path), manifest=Manifest.read(path))
    ends = (read_hour(dataset.folder, hour) for hour in hour_bounds(dataset.folder) or ())
    methods = sorted({each.origin.method for each in ends if each is not None})
    if len(methods) > 1:  # of the first and the last hour: reading all records takes long
        reporter.warn(
            "{}: its hours were made by methods {}, whose results do not compare; "
            "measure the older hours again",
            path,
            ", ".join(map(str, methods)),
        )
    return dataset
