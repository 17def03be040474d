"""Views of a dataset's tables in DuckDB, over complete hours, with converted columns, too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import duckdb
import geopandas as gpd
import pyarrow as pa

from gis_radar.base import STEPS_PER_SECOND, Reporter
from gis_radar.dataset.days.lane_measures import maker_of
from gis_radar.dataset.days.rollups import with_month
from gis_radar.dataset.days.tables import STEPS_PER_QUARTER, records_of
from gis_radar.dataset.files.parts import days_of, hour_text, part_path
from gis_radar.dataset.files.records import HourRecord
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.source import DatasetFiles, NoVehiclesError
from gis_radar.dataset.files.tables import (
    DAY_TABLES,
    HOUR_TABLES,
    MONTH_TABLES,
    POSES,
    RECORDINGS,
    SIGHTS,
    TABLES,
)
from gis_radar.dataset.files.units import UNITS
from gis_radar.dataset.questions.profiles import roll_ups
from gis_radar.hdmap import LANES_LAYER
from gis_radar.measures import LaneNetwork, lane_names

LAYERS = ("tiles", "lanes", "stop_lines")
_BEGIN = f"epoch(date)::BIGINT * {STEPS_PER_SECOND} + interval * {STEPS_PER_QUARTER}::BIGINT"


def views_of_sites(
    sites: Mapping[str, DatasetFiles], connection: duckdb.DuckDBPyConnection, names: set[str],
    reporter: Reporter,
) -> list[Path]:  # fmt: skip
    """Make the views of some tables over several sites, with a first column `site`.

    Parameters
    ----------
    sites : mapping
        Datasets by the names of their sites; one alone by an empty name has no such column.
    connection, names, reporter
        As for :func:`make_views`.

    Returns
    -------
    list of Path
        The files that the views read.
    """
    if list(sites) == [""]:
        return make_views(sites[""], connection, names, reporter)
    paths = []
    for number, dataset in enumerate(sites.values()):
        paths += make_views(dataset, connection, names, reporter, prefix=f"_{number}_")
    for name in names:
        parts = (
            f"SELECT {quoted(site)} AS site, * FROM _{number}_{name}"  # noqa: S608 - ours
            for number, site in enumerate(sites)
        )
        connection.execute(f"CREATE VIEW {name} AS {' UNION ALL BY NAME '.join(parts)}")
    return paths


def make_views(
    dataset: DatasetFiles, connection: duckdb.DuckDBPyConnection, names: set[str],
    reporter: Reporter, *, prefix: str = "",
) -> list[Path]:  # fmt: skip
    """Make the views of some tables.

    Parameters
    ----------
    dataset : DatasetFiles
        The dataset, of which complete hours are read.
    connection : duckdb.DuckDBPyConnection
        Connection in which the views are made.
    names : set of str
        Names of the tables.
    reporter : Reporter
        Receives a warning where parts of a table were deleted; they are left out.
    prefix : str
        Prefix of the names of the views.

    Returns
    -------
    list of Path
        The files that the views read.

    Raises
    ------
    InputError
        If a part is not the one of its hour's record.
    """
    views = _Views(dataset, connection, prefix, reporter)
    records = dataset.records()
    paths = []
    for tables, view in (
        (HOUR_TABLES, views.hours),
        (DAY_TABLES, views.days),
        (MONTH_TABLES, views.months),
    ):
        for table in tables:
            if table.name in names:
                paths += view(table, records)
    for table in (RECORDINGS, POSES, SIGHTS):
        if table.name in names:
            views.view_of_rows(table, dataset.single_table(table))
    for layer in names.intersection(LAYERS):
        connection.register(f"{prefix}{layer}", _layer(dataset, layer, is_one_of_many=bool(prefix)))
    return paths


def _layer(dataset: DatasetFiles, layer: str, *, is_one_of_many: bool) -> pa.Table:
    """Return a layer without its geometry; where one of many sites lacks it, no rows."""
    try:
        rows = dataset.layer(layer)
    except NoVehiclesError:
        if not is_one_of_many:
            raise
        return pa.table({"lane": pa.array([], pa.int64())})
    if layer == LANES_LAYER and dataset.has_vehicles:
        rows = _with_names(rows, roll_ups(dataset).traffic.network)
    return pa.Table.from_pandas(rows.drop(columns="geometry"), preserve_index=False)


def _with_names(lanes: gpd.GeoDataFrame, network: LaneNetwork) -> gpd.GeoDataFrame:
    """Return lanes with a column `name`, as the methods of a dataset call them."""
    names = dict(zip(network.lane.tolist(), lane_names(lanes, network), strict=True))
    return lanes.assign(name=lanes["lane"].map(names).astype(object))


def catalogue_of(folders: Sequence[Path], place: str) -> str:
    """Return SQL that makes views of the tables of datasets in DuckDB, for those that have files.

    Parameters
    ----------
    folders : sequence of Path
        The datasets.
    place : str
        Pattern of their folders as readers of the views see them: `s3://bucket/city/site=*`.
    """
    lines = []
    for table in TABLES.values():
        inner = f"{table.name}/*/*" if table.period != "dataset" else table.name
        if any(any(folder.glob(f"{inner}.parquet")) for folder in folders):
            files = quoted(f"{place}/{inner}.parquet")
            lines.append(
                f"CREATE OR REPLACE VIEW {table.name} AS FROM read_parquet({files}, "
                "hive_partitioning = true, hive_types = {'site': VARCHAR}, union_by_name = true);\n"
            )
    return "".join(lines)


class _Views:
    """Maker of views of tables."""

    def __init__(
        self, dataset: DatasetFiles, connection: duckdb.DuckDBPyConnection, prefix: str,
        reporter: Reporter,
    ) -> None:  # fmt: skip
        self._dataset, self._connection, self._prefix = dataset, connection, prefix
        self._reporter = reporter

    def hours(self, table: TableSchema, records: Mapping[int, HourRecord]) -> list[Path]:
        """Make the view of a table of hours; return its files, each checked."""
        folder, paths = self._dataset.folder, []
        there = {hour: each for hour, each in records.items() if table.name not in each.dropped}
        if gone := records.keys() - there.keys():
            self._reporter.warn(
                "{} up to {} were deleted, and are left out of the answer",
                table.name, hour_text(max(gone) + 1),
            )  # fmt: skip
        for hour, record in there.items():
            record.check_bytes(folder, table)  # DuckDB, unlike Arrow, checks no checksums
            paths.append(part_path(folder, table, hour))
        if paths:
            self._view(table.name, table.names, f"read_parquet([{_file_list(paths)}])")
        else:
            self.view_of_rows(table, table.empty())
        return paths

    def days(self, table: TableSchema, records: Mapping[int, HourRecord]) -> list[Path]:
        """Make the view of a table of dates; dates that are not up to date are updated first."""
        folder, tiles = self._dataset.folder, self._dataset.manifest.fingerprint
        maker, paths, stale = maker_of(table, folder, tiles), [], {}
        for day in days_of(records):
            of_day = records_of(day, records)
            keys, file = maker.keys(day, of_day), maker.file(table, day)
            if keys and file.is_made_of(keys):
                file.check_pages()  # as for hours
                paths.append(file.path)
            else:
                stale.update(of_day)
        further = pa.field("first_step", pa.int64())
        begins = f"{_BEGIN} AS first_step"
        self._view_of_rows_and_files(
            table, further, maker.read(table, stale), paths, begins, "{'date': DATE}"
        )
        return paths

    def months(self, table: TableSchema, records: Mapping[int, HourRecord]) -> list[Path]:
        """Make the view of a roll-up; months that are not up to date are summed first."""
        rolled, paths, made = roll_ups(self._dataset), [], []
        for month in rolled.months(records):
            if rolled.is_current(table, month):
                (file := rolled.file(table, month)).check_pages()
                paths.append(file.path)
            else:
                made.append(with_month(rolled.read(table, month), month))
        further = pa.field("month", pa.string())
        self._view_of_rows_and_files(table, further, made, paths, "month", "{'month': VARCHAR}")
        return paths

    def _view_of_rows_and_files(
        self, table: TableSchema, further: pa.Field, made: Iterable[pa.Table],
        paths: Sequence[Path], column: str, types: str,
    ) -> None:  # fmt: skip
        """Make a view of rows held in memory and of files, which get a further `column`."""
        names, table_name = [*table.names, further.name], f"_made_{self._prefix}{table.name}"
        empty = table.schema.append(further).empty_table()
        self._connection.register(table_name, pa.concat_tables([empty, *made]))
        source = _select(names, table_name)
        if paths:
            files = f"read_parquet([{_file_list(paths)}], hive_types = {types})"
            source = f"{source} UNION ALL {_select([*table.names, column], files)}"
        self._view(table.name, names, f"({source})")

    def view_of_rows(self, table: TableSchema, rows: pa.Table) -> None:
        """Make a view of rows held in memory."""
        table_name = f"_held_{self._prefix}{table.name}"
        self._connection.register(table_name, rows)
        self._view(table.name, table.names, table_name)

    def _view(self, name: str, columns: list[str], source: str) -> None:
        """Make a view of the columns of the files and of the converted ones."""
        origin = self._dataset.manifest.origin
        further = [f'{UNITS[c].sql(c, origin)} AS "{UNITS[c].name}"' for c in columns if c in UNITS]
        self._connection.execute(
            f"CREATE VIEW {self._prefix}{name} AS {_select([*columns, *further], source)}"
        )


def _select(columns: Iterable[str], source: str) -> str:
    return f"SELECT {', '.join(columns)} FROM {source}"  # noqa: S608 - names and files of ours


def _file_list(paths: Iterable[Path]) -> str:
    return ", ".join(quoted(path.resolve().as_posix()) for path in paths)


def quoted(text: str) -> str:
    """Return a text as an SQL string literal."""
    return "'" + text.replace("'", "''") + "'"
