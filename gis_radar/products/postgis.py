"""A dataset in PostGIS: tiles, lanes, sensors and traffic by quarter of an hour as tables.

One transaction makes a schema equal to the dataset: dates that are new or were measured again are
sent, dates that the dataset no longer has are removed, all others stay as they are.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import shapely
from pyproj import CRS

from gis_radar.base import QUIET, CrsError, GisRadarError, OutputError, Reporter, Text, UsageError
from gis_radar.dataset import TILE_COUNTS, Dataset, LaneTraffic, TrafficReader, open_dataset
from gis_radar.hdmap import TILE_FIELDS
from gis_radar.measures import lane_names
from gis_radar.products.traffic import TITLES

if TYPE_CHECKING:
    from psycopg import Cursor

VERSION = 2  # of the tables; raised when they change
MARK = "gis_radar,"  # begin of the comment on a schema of ours
_CHANNEL = "qgis"  # channel on which QGIS listens for "Refresh layer on notification"
_CONNECT_S = 10  # longest wait for a server's answer, seconds
LOCK_S = 60.0  # longest wait for a table that another holds, seconds: readers would wait behind it
_LOCK_NOT_AVAILABLE = "55P03"  # SQLSTATE; the server's words may be of any language
_EPOCH = date(1970, 1, 1)
_NAME = re.compile(r"[a-z_][a-z0-9_]{0,62}")
_TYPES = {
    "int32": "integer", "int": "bigint", "uint": "bigint", "flo": "double precision",
    "bool": "boolean", "dat": "timestamptz",
}  # fmt: skip
"""Types of PostgreSQL by the beginning of those of pandas; all others are text."""
_TIMES = {"begin": "begin_time", "end": "end_time"}  # END is a word of SQL
_KEYS = {
    "tiles": ["tile_id"], "lanes": ["lane"], "sensors": ["sensor"],
    "tile_counts": ["tile_id", "begin_time"], "lane_measures": ["lane", "begin_time"],
    "turns": ["from_lane", "to_lane", "begin_time"],
}  # fmt: skip
_BY_DAY = ("tile_counts", "lane_measures", "turns")
_ROWS = {
    "tiles": "Slices of lanes, on which occupancy is counted",
    "lanes": "Lanes between junctions, from their begin to their stop line",
    "sensors": "Where radars stand and look: the pose of each one's last recording",
    "tile_counts": "Steps of 50 ms of a tile in a quarter of an hour",
    "lane_measures": "Traffic of a lane in a quarter of an hour; null where it was not visible",
    "turns": "Traffic from lane to lane in a quarter of an hour",
}
_OCCUPANCY = """
    CREATE OR REPLACE VIEW {schema}.occupancy AS
    SELECT t.*, c.occupied_steps / 20.0 AS occupied_s, c.visible_steps / 20.0 AS visible_s,
        c.occupied_steps::float8 / nullif(c.visible_steps, 0) AS occupancy
    FROM {schema}.tiles t JOIN {schema}.tile_sums c USING (tile_id)
"""
# One row a tile, so that a map is drawn at once however many dates there are.
_SUMS = """
    CREATE TABLE {schema}.tile_sums (tile_id bigint PRIMARY KEY, intervals bigint NOT NULL,
        occupied_steps bigint NOT NULL, visible_steps bigint NOT NULL)
"""
# With 1 the counts of a time are added to the sums, with -1 subtracted.
_ADD_SUMS = """
    INSERT INTO {schema}.tile_sums AS s
    SELECT tile_id, sum(sign), sum(sign * occupied_steps), sum(sign * visible_steps)
    FROM {schema}.tile_counts, (SELECT %s::int AS sign) signs
    WHERE begin_time >= %s AND begin_time < %s GROUP BY tile_id
    ON CONFLICT (tile_id) DO UPDATE SET intervals = s.intervals + excluded.intervals,
        occupied_steps = s.occupied_steps + excluded.occupied_steps,
        visible_steps = s.visible_steps + excluded.visible_steps
"""
_LATEST = """
    CREATE OR REPLACE VIEW {schema}.latest_traffic AS
    SELECT DISTINCT ON (lane) m.*, l.name, l.geometry
    FROM {schema}.lane_measures m JOIN {schema}.lanes l USING (lane) ORDER BY lane, begin_time DESC
"""
PUBLISHED_VIEWS = {
    "occupancy": (_OCCUPANCY, "Share of time that a vehicle is on a tile, over all dates"),
    "latest_traffic": (_LATEST, "Traffic of each lane in its last quarter of an hour"),
}


@dataclass(frozen=True, kw_only=True)
class Publication:
    """Result of a publication.

    Parameters
    ----------
    place : str
        Database and schema, without user and password.
    sent, kept, removed : int
        Number of dates that were sent, kept as they were, and removed.
    rows : dict
        Rows sent, by table.
    """

    place: str
    sent: int
    kept: int
    removed: int
    rows: Mapping[str, int]

    def figures(self) -> dict[str, Any]:
        """Return the figures of the result by name."""
        return {
            "database": self.place, "dates_sent": self.sent, "dates_kept": self.kept,
            "dates_removed": self.removed, **{f"rows_of_{k}": n for k, n in self.rows.items()},
        }  # fmt: skip


def publish(
    dataset: Dataset | str | Path, url: str, *, schema: str = "gis_radar",
    reader: str | None = None, notify: bool = True, reporter: Reporter = QUIET,
) -> Publication:  # fmt: skip
    """Make a schema of a PostGIS database equal to a dataset, in one transaction.

    Tables `tiles`, `lanes`, `sensors`, `tile_counts`, `lane_measures` and `turns` with keys,
    indexes of space and time and comments on columns; views `occupancy` and `latest_traffic`.
    Listeners on the channel `qgis` are notified.

    Parameters
    ----------
    dataset : Dataset, str or Path
        A dataset, or its folder, whose coordinate system has an EPSG code.
    url : str
        The database, as libpq takes it: `postgresql://user@host/database`. The password may come
        from `PGPASSWORD` or `~/.pgpass`.
    schema : str
        Schema of the tables; one for each site.
    reader : str, optional
        A role that may read the tables and nothing more.
    notify : bool
        Whether listeners on the channel `qgis` are notified.
    reporter : Reporter
        Receives the progress.

    Returns
    -------
    Publication
        What was sent.

    Raises
    ------
    UsageError
        If the address or the schema's name is invalid.
    CrsError
        If the coordinate system has no EPSG code.
    OutputError
        If the database cannot be reached or written, lacks PostGIS, or the schema holds another
        site or tables of another version; the database is then as it was.
    """
    require_name(schema)
    dataset = open_dataset(dataset, reporter=reporter)
    code = CRS.from_user_input(dataset.crs).to_epsg()
    if code is None:
        raise CrsError("{}: {} has no EPSG code, which PostGIS needs", dataset.folder, dataset.crs)
    with opened_session(url, schema, code) as session:
        session.prepare(dataset.manifest.fingerprint)
        published, days = session.published(), _digests(dataset)
        changed = [day for day in days if days[day] != published.get(day)]
        removed = [day for day in published if day not in days]
        session.remove([*removed, *(day for day in changed if day in published)])
        session.replace_layers(dataset)
        for done, day in enumerate(changed):
            reporter.progress("publishing", done, len(changed))
            session.send_day(dataset, day, days[day])
        reporter.progress("publishing", len(changed), len(changed))
        session.make_views()
        session.grant(reader)
        if notify:
            session.notify(schema)
    return Publication(
        place=f"{session.place}, schema {schema}", sent=len(changed), kept=len(days) - len(changed),
        removed=len(removed), rows=session.rows,
    )  # fmt: skip


def require_name(schema: str) -> None:
    """Refuse a name of a schema that would have to be quoted.

    Raises
    ------
    UsageError
        If it is one.
    """
    if not _NAME.fullmatch(schema):
        raise UsageError("schema {} is no name of small letters, digits and _", schema)


def _digests(dataset: Dataset) -> dict[date, str]:
    """Return the digest of each date's inputs: the parts of its hours and of the hour before.

    The poses, on which standard errors rest, the free speeds, on which delays rest, and the method
    of the lane measures are included.
    """
    records, poses = dataset.records(), pd.DataFrame(dataset.poses()).drop(columns="geometry")
    free_speeds = pd.DataFrame(dataset.lanes()).reindex(columns=["lane", "speed_limit_kmh"])
    traffic = LaneTraffic.of(dataset)
    traffic.remember(records)
    digests = {}
    for day in sorted({hour // 24 for hour in records}):
        hours = [hour for hour in range(24 * day - 1, 24 * day + 24) if hour in records]
        made = [(hour, sorted(records[hour].parts.items()), records[hour].origin) for hour in hours]
        keys = traffic.keys(24 * day, {hour: records[hour] for hour in hours if hour >= 24 * day})
        follows = repr((made, poses.to_json(), free_speeds.to_json(), keys))
        digests[_EPOCH + timedelta(days=day)] = hashlib.sha256(follows.encode()).hexdigest()
    return digests


@contextmanager
def opened_session(url: str, schema: str, srid: int = 0) -> Iterator[Session]:
    """Open a session whose changes are committed if nothing is raised."""
    try:
        import psycopg  # noqa: PLC0415 - an extra
        from psycopg.conninfo import conninfo_to_dict  # noqa: PLC0415
    except ImportError as error:
        raise GisRadarError(
            "psycopg is not installed", hint="pip install 'gis-radar[postgis]'"
        ) from error
    try:
        asked = conninfo_to_dict(url)
    except psycopg.ProgrammingError as error:
        raise UsageError(
            "the address of the database is none", hint="such as postgresql://user@host/database"
        ) from error
    place = f"{asked.get('host', 'localhost')}/{asked.get('dbname', asked.get('user', ''))}"
    try:
        with psycopg.connect(
            url, connect_timeout=_CONNECT_S, application_name="gis-radar", client_encoding="utf8"
        ) as connection:
            connection.execute(f"SET LOCAL lock_timeout = {1000 * LOCK_S:.0f}")
            lock = "SELECT pg_try_advisory_xact_lock(hashtext(%s))"
            row = connection.execute(lock, [f"gis_radar {schema}"]).fetchone()
            if row is None or not row[0]:
                raise OutputError("{}: schema {} is being published just now", place, schema)
            yield Session(cursor=connection.cursor(), schema=schema, place=place, srid=srid)
    except psycopg.Error as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        hint = _hint_for(reason, error.sqlstate)
        raise OutputError("{}: {}", place, reason, hint=hint) from error


def _hint_for(reason: str, state: str | None) -> Text:
    if 'extension "postgis"' in reason:
        return Text("install PostGIS, and CREATE EXTENSION postgis in the database as a superuser")
    if state == _LOCK_NOT_AVAILABLE:
        return Text("another program holds a table; the database is as it was: try again later")
    return Text("the database is as it was")


class Session:
    """Transaction in which a schema is updated."""

    def __init__(self, *, cursor: Cursor, schema: str, place: str, srid: int) -> None:
        self.cursor, self.schema, self.place, self.srid = cursor, schema, place, srid
        self.is_new = False
        self.rows: dict[str, int] = {}

    def run(self, statement: str, *values: Any, text: str = "", **names: str) -> None:
        """Execute a statement: values for `%s`, a quoted `{text}`, names for the other holes."""
        composed = self.quoted(statement, text=text, schema=self.schema, **names)
        self.cursor.execute(composed, values or None)

    def ask(self, statement: str, *values: Any) -> Any:
        """Return the first value of the answer of a statement."""
        self.run(statement, *values)
        row = self.cursor.fetchone()
        return None if row is None else row[0]

    def quoted(self, template: str, *, text: str = "", **names: str) -> str:
        """Return a part of a statement: a quoted `{text}`, names for the other holes."""
        from psycopg.sql import SQL, Identifier, Literal  # noqa: PLC0415 - an extra

        identifiers = {hole: Identifier(name) for hole, name in names.items()}
        return SQL(template).format(text=Literal(text), **identifiers).as_string(self.cursor)

    def columns(self, schema: str, table: str) -> dict[str, str]:
        """Return the columns of a table or view with their types; none if it is missing."""
        self.run(
            "SELECT attname, format_type(atttypid, atttypmod) FROM pg_attribute "
            "WHERE attrelid = to_regclass(%s) AND attnum > 0 AND NOT attisdropped ORDER BY attnum",
            f"{schema}.{table}",
        )
        return dict(self.cursor.fetchall())

    def prepare(self, tiles: str) -> None:
        """Make the schema if it is missing; refuse one of another version or other tiles."""
        self.prepare_extension()
        self.prepare_schema(f"{MARK} tables of version {VERSION}, tiles {tiles}")
        if self.is_new:
            self._prepare_tables()

    def prepare_extension(self) -> None:
        """Add PostGIS to the database if it is missing."""
        self.run("CREATE EXTENSION IF NOT EXISTS postgis")

    def prepare_schema(self, expected: str) -> None:
        """Make the schema if it is missing, with a comment; refuse one with another comment."""
        exists = self.ask("SELECT to_regnamespace(%s) IS NOT NULL", self.schema)
        if not exists:  # where it exists, no right to create it is needed
            self.run("CREATE SCHEMA {schema}")
        comment = self.ask(
            "SELECT obj_description(to_regnamespace(%s), 'pg_namespace')", self.schema
        )
        self.is_new = not comment
        if comment != expected and (comment or (exists and self._holds_anything())):
            hint = Text("name another --schema")
            if comment and comment.startswith(MARK):  # never propose to drop what others made
                hint = Text("name another --schema, or drop {} and publish again", self.schema)
            raise OutputError(
                "{}: schema {} holds something else ({})", self.place, self.schema,
                comment or "tables of others", hint=hint,
            )  # fmt: skip
        if self.is_new:
            self.run("COMMENT ON SCHEMA {schema} IS {text}", text=expected)

    def _prepare_tables(self) -> None:
        self.run(
            "CREATE TABLE {schema}.publication "
            "(day date PRIMARY KEY, digest text NOT NULL, published timestamptz DEFAULT now())"
        )
        self.run(
            "COMMENT ON TABLE {schema}.publication IS 'Dates that are published, with a digest'"
        )
        self.run(_SUMS)
        self.run("COMMENT ON TABLE {schema}.tile_sums IS 'Sums of a tile over all dates'")

    def _holds_anything(self) -> bool:
        asked = "SELECT EXISTS (SELECT FROM pg_class WHERE relnamespace = to_regnamespace(%s))"
        return bool(self.ask(asked, self.schema))

    def published(self) -> dict[date, str]:
        """Return the published dates, with their digests."""
        self.run("SELECT day, digest FROM {schema}.publication")
        return dict(self.cursor.fetchall())

    def remove(self, days: list[date]) -> None:
        """Remove dates from all tables."""
        for day in days:
            begin = datetime.combine(day, datetime.min.time(), UTC)
            if self.is_there("tile_counts"):
                self.run(_ADD_SUMS, -1, begin, begin + timedelta(days=1))
            for table in filter(self.is_there, _BY_DAY):
                self.run(
                    "DELETE FROM {schema}.{table} WHERE begin_time >= %s AND begin_time < %s",
                    begin, begin + timedelta(days=1), table=table,
                )  # fmt: skip
            self.run("DELETE FROM {schema}.publication WHERE day = %s", day)
        if days:
            self.run("DELETE FROM {schema}.tile_sums WHERE intervals = 0")

    def replace_layers(self, dataset: Dataset) -> None:
        """Send lanes and sensors anew, as names and poses may have changed, and tiles once."""
        lanes = dataset.lanes()
        names: dict[int, str] = {}
        if dataset.has_vehicles:
            network = LaneTraffic.of(dataset).network
            names = dict(zip(network.lane.tolist(), lane_names(lanes, network), strict=True))
        lanes = lanes.drop(columns="name", errors="ignore")  # `names` includes lanes' own names
        lanes.insert(1, "name", lanes["lane"].map(names).astype("string"))
        layers = {"lanes": lanes, "sensors": dataset.last_poses().drop(columns="document")}
        if self.is_new:
            layers["tiles"] = dataset.tiles()
        for name, table in layers.items():
            self._create(name, table)
            self.run("DELETE FROM {schema}.{table}", table=name)
            self._copy(name, table)

    def send_day(self, dataset: Dataset, day: date, digest: str) -> None:
        """Send the measures of a date."""
        begin = datetime.combine(day, datetime.min.time(), UTC)
        end = begin + timedelta(days=1)
        counts = dataset.tile_counts(begin=begin, end=end)
        tables: dict[str, pd.DataFrame] = {"tile_counts": counts.drop(columns="interval")}
        if dataset.has_vehicles:
            reader = TrafficReader(dataset=dataset, span=dataset.span(begin, end))
            lanes, turns = reader.lanes(), reader.turns()
            tables["lane_measures"] = pd.DataFrame(lanes).drop(columns=["name", "geometry"])
            without = ["from_name", "to_name", "geometry"]
            tables["turns"] = pd.DataFrame(turns).drop(columns=without)
        for name, table in tables.items():
            self._create(name, table)
            self._copy(name, table)
        self.run(_ADD_SUMS, 1, begin, end)
        self.run("INSERT INTO {schema}.publication VALUES (%s, %s)", day, digest)

    def make_views(self) -> None:
        """Make the views."""
        for name, (statement, comment) in PUBLISHED_VIEWS.items():
            if self.is_there("lane_measures"):
                self.run(statement)
                self.run("COMMENT ON VIEW {schema}.{view} IS {text}", text=comment, view=name)

    def grant(self, reader: str | None) -> None:
        """Give the reader its rights."""
        if reader is not None:
            self.run("GRANT USAGE ON SCHEMA {schema} TO {role}", role=reader)
            self.run("GRANT SELECT ON ALL TABLES IN SCHEMA {schema} TO {role}", role=reader)
            later = "ALTER DEFAULT PRIVILEGES IN SCHEMA {schema} GRANT SELECT ON TABLES TO {role}"
            self.run(later, role=reader)

    def notify(self, schema: str) -> None:
        """Notify listeners that a schema has changed; they hear it once this is committed."""
        self.run("SELECT pg_notify(%s, %s)", _CHANNEL, f"gis_radar {schema}")

    def _create(self, name: str, table: pd.DataFrame) -> None:
        """Make a table if it is missing, with key, indexes and comments."""
        if self.is_there(name):
            return
        types = {_TIMES.get(str(c), str(c)): self._type_of(table, str(c)) for c in table}
        columns = ", ".join(f'"{column}" {kind}' for column, kind in types.items())
        key = ", ".join(_KEYS[name])
        self.run(f"CREATE TABLE {{schema}}.{{table}} ({columns}, PRIMARY KEY ({key}))", table=name)
        # dates are appended one after the other
        index = "gist (geometry)" if "geometry" in table else "brin (begin_time)"
        self.run(f"CREATE INDEX ON {{schema}}.{{table}} USING {index}", table=name)
        self.run("COMMENT ON TABLE {schema}.{table} IS {text}", text=_ROWS[name], table=name)
        for column in map(str, table):
            if text := _meaning(name, column):
                statement = "COMMENT ON COLUMN {schema}.{table}.{column} IS {text}"
                self.run(statement, text=text, table=name, column=_TIMES.get(column, column))

    def _type_of(self, table: pd.DataFrame, column: str) -> str:
        if isinstance(table, gpd.GeoDataFrame) and column == table.geometry.name:
            kinds = table.geom_type.unique()
            kind = kinds[0] if len(kinds) == 1 else "Geometry"
            return f"geometry({kind}{'Z' if table.has_z.any() else ''}, {self.srid})"
        kind = str(table[column].dtype).lower()
        return next((sql for start, sql in _TYPES.items() if kind.startswith(start)), "text")

    def is_there(self, name: str) -> bool:
        """Return whether the schema has a table or view."""
        return self.ask("SELECT to_regclass(%s)", f"{self.schema}.{name}") is not None

    def _copy(self, name: str, table: pd.DataFrame) -> None:
        from psycopg.sql import SQL, Identifier  # noqa: PLC0415 - an extra

        shown = pd.DataFrame(table).rename(columns=_TIMES)
        if isinstance(table, gpd.GeoDataFrame):
            placed = shapely.set_srid(np.asarray(table.geometry), self.srid)
            shown["geometry"] = shapely.to_wkb(placed, hex=True, include_srid=True)
        columns = SQL(", ").join([Identifier(str(column)) for column in shown])
        place = Identifier(self.schema, name)
        copy = SQL("COPY {} ({}) FROM STDIN (FORMAT csv)").format(place, columns)
        rows, text = pa.Table.from_pandas(shown, preserve_index=False), io.BytesIO()
        pyarrow.csv.write_csv(rows, text, pyarrow.csv.WriteOptions(include_header=False))
        with self.cursor.copy(copy) as target:
            target.write(text.getvalue())
        self.rows[name] = self.rows.get(name, 0) + len(shown)


def _meaning(table: str, column: str) -> str:
    """Return the meaning of a column, with its unit."""
    if table == "tile_counts":
        counts = {each.name: each.means for each in TILE_COUNTS.columns}
        return counts.get(column, "begin of the quarter of an hour" if column == "begin" else "")
    if table == "tiles":
        return TILE_FIELDS[column][1] if column in TILE_FIELDS else ""
    return TITLES[column].template if column in TITLES else ""
