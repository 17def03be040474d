"""Check and open GeoPackages; write their layers, with styles that QGIS loads by itself."""

from __future__ import annotations

import hashlib
import marshal
import sqlite3
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

import geopandas as gpd
import pyarrow as pa
import pyogrio
import pyogrio.util
import shapely
from pyproj.exceptions import ProjError

from gis_radar.base.errors import InputError, OutputError, first_line
from gis_radar.base.files import FILE_DATE
from gis_radar.base.progress import QUIET, Reporter
from gis_radar.base.texts import Text

_GPKG_VERSION = "1.2"
"""The version of the GeoPackages that we write: the GDAL of QGIS 3.40 warns of later ones."""

_FILE_TIME = f"{FILE_DATE}T00:00:00.000Z"
_GDAL_DATE_OPTION = "OGR_CURRENT_DATE"

SQLITE = b"SQLite format 3\0"
_APPLICATION_IDS = {b"GPKG", b"GP10", b"GP11"}  # application ids of GeoPackage 1.0, 1.1 and later
_APPLICATION_ID_AT = 68  # bytes, in SQLite's header
_DAMAGE = (
    pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, sqlite3.Error,
    shapely.errors.ShapelyError, pa.ArrowException, OSError, ValueError, TypeError, LookupError,
    OverflowError, RecursionError, ProjError,
)  # fmt: skip
"""Errors that libraries raise for a damaged file."""
_LOCKED = "database is locked"  # in SQLite's message
_HELD_HINT = "end editing it there, or close it, and try again; nothing is lost"
LOCK_WAIT_S = 2.0  # wait for a program that is about to end its writing
_LINE_BREAK = Text("its name, or its folder's, holds a line break: rename it")
# Errors for another layer, table or format than asked for: the file itself is not damaged.
_WRONG_CONTENT = (*_DAMAGE[:2], sqlite3.OperationalError)

# The table as QGIS makes it; GDAL and QGIS look for it by this name.
_CREATE_STYLES = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    f_table_catalog TEXT(256),
    f_table_schema TEXT(256),
    f_table_name TEXT(256),
    f_geometry_column TEXT(256),
    styleName TEXT(30),
    styleQML TEXT,
    styleSLD TEXT,
    useAsDefault BOOLEAN,
    description TEXT,
    owner TEXT(30),
    ui TEXT(30),
    update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))
)
"""
_ADD_STYLES_TABLE = """
INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change)
VALUES ('layer_styles', 'attributes', 'layer_styles', '', ?)
"""
_ADD_STYLE = """
INSERT INTO layer_styles (
    f_table_catalog, f_table_schema, f_table_name, f_geometry_column,
    styleName, styleQML, styleSLD, useAsDefault, description, owner, update_time
)
SELECT '', '', table_name, column_name, ?, ?, ?, 1, ?, ?, ?
FROM gpkg_geometry_columns WHERE table_name = ?
"""


@contextmanager
def opened_package(path: str | Path, *, what: str, hint: str = "") -> Iterator[Path]:
    """Check that a file is a GeoPackage; errors of libraries in the block become an `InputError`.

    GDAL chooses its driver by the content, and some drivers open what the content names: files
    and addresses. So the content is looked at before GDAL sees it.

    Parameters
    ----------
    path : str or Path
        The file.
    what : str
        Expected content, for the message: `a heat map`.
    hint : str
        How to get one, for the message.

    Yields
    ------
    Path
        The absolute path.

    Raises
    ------
    InputError
        If there is no such file, it is no GeoPackage, it is damaged, or its name stands for a file
        in an archive.
    """
    if not Path(path).is_file():
        raise InputError("{}: no such file", path, hint=hint)
    with library_errors(path, what=what, hint=hint):
        with Path(path).open("rb") as file:
            head = file.read(100)
        if (
            not head.startswith(SQLITE)
            or head[_APPLICATION_ID_AT : _APPLICATION_ID_AT + 4] not in _APPLICATION_IDS
        ):
            raise InputError("{}: not {}: it is no GeoPackage", path, what, hint=hint)
        yield plain_place(path)


def plain_place(path: str | Path) -> Path:
    """Return the absolute path of a file that GDAL opens as that very file.

    Raises
    ------
    InputError
        If its name makes pyogrio or GDAL open a file within it, or another one.
    """
    place = Path(path).resolve()
    if not str(place).isprintable() and _is_in_archive(place):
        raise InputError("{}: {}", repr(str(path)), _LINE_BREAK)
    if _is_in_archive(place) or place.suffix.lower() == ".zip":
        raise InputError(
            "{}: cannot be read under this name, which stands for a file in an archive",
            path,
            hint="rename it, or its folder: no .zip at the end, no ! and no ;",
        )
    return place


def _is_in_archive(place: Path) -> bool:
    """Return whether pyogrio takes an absolute path for that of a file in an archive."""
    return bool(pyogrio.util.vsi_path(place) != str(place))


@contextmanager
def library_errors(
    path: str | Path, *, what: str, hint: str = "", reporter: Reporter = QUIET
) -> Iterator[None]:
    """Turn errors of libraries that read a file into one that names it; pass on their warnings.

    Parameters
    ----------
    path, what, hint, reporter
        As :func:`opened_package` takes them.

    Raises
    ------
    InputError
        Where the block raises one of :data:`_DAMAGE`.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except _DAMAGE as error:
            if _LOCKED in str(error):
                raise InputError(
                    "{}: another program has it locked", path, hint=_HELD_HINT
                ) from error
            wrong = Text("not {}", what) if isinstance(error, _WRONG_CONTENT) else "damaged"
            raise InputError("{}: {}: {}", path, wrong, first_line(error), hint=hint) from error
    for text in dict.fromkeys(str(each.message).partition("\n")[0] for each in caught):
        reporter.warn("{}: {}", path, text)


_CREATE_FIELDS = """
CREATE TABLE IF NOT EXISTS gpkg_data_columns (
    table_name TEXT NOT NULL,
    column_name TEXT NOT NULL,
    name TEXT,
    title TEXT,
    description TEXT,
    mime_type TEXT,
    constraint_name TEXT,
    CONSTRAINT pk_gdc PRIMARY KEY (table_name, column_name),
    CONSTRAINT gdc_tn UNIQUE (table_name, name)
)
"""
_ADD_SCHEMA_EXTENSION = """
INSERT INTO gpkg_extensions (table_name, column_name, extension_name, definition, scope)
SELECT 'gpkg_data_columns', NULL, 'gpkg_schema',
    'http://www.geopackage.org/spec121/#extension_schema', 'read-write'
WHERE NOT EXISTS (SELECT 1 FROM gpkg_extensions WHERE table_name = 'gpkg_data_columns')
"""
_ADD_METADATA = """
INSERT INTO gpkg_metadata (md_scope, md_standard_uri, mime_type, metadata)
VALUES ('dataset', 'http://mrcc.com/qgis.dtd', 'text/xml', ?)
"""
_ADD_METADATA_REFERENCE = """
INSERT INTO gpkg_metadata_reference (
    reference_scope, table_name, column_name, row_id_value, timestamp, md_file_id, md_parent_id
)
VALUES ('table', ?, NULL, NULL, ?, ?, NULL)
"""


class LayerNotes(NamedTuple):
    """Title and text of a layer for people, and of each of its fields, by name."""

    title: str
    abstract: str
    fields: Mapping[str, tuple[str, str]]


def describe_layers(database: sqlite3.Connection, notes: Mapping[str, LayerNotes]) -> None:
    """Write titles and meaning of layers and fields: QGIS shows them as metadata and aliases.

    Parameters
    ----------
    database : sqlite3.Connection
        A GeoPackage that GDAL has written with metadata of its layers.
    notes : mapping
        Notes by layer; fields that the layer does not have are left out.
    """
    database.execute(_CREATE_FIELDS)
    database.execute(_ADD_SCHEMA_EXTENSION)
    for layer, about in notes.items():
        columns = {row[1] for row in database.execute(f'PRAGMA table_xinfo("{layer}")')}
        rows = [
            (layer, name, title, title, text)
            for name, (title, text) in about.fields.items()
            if name in columns
        ]
        database.executemany(
            "INSERT INTO gpkg_data_columns (table_name, column_name, name, title, description) "
            "VALUES (?, ?, ?, ?, ?)", rows,
        )  # fmt: skip
        database.execute(
            "UPDATE gpkg_contents SET description = ? WHERE table_name = ?", (about.abstract, layer)
        )
        row = database.execute(_ADD_METADATA, (_qgis_metadata(about),))
        database.execute(_ADD_METADATA_REFERENCE, (layer, _FILE_TIME, row.lastrowid))


def _qgis_metadata(about: LayerNotes) -> str:
    """Return the metadata of a layer as QGIS writes it."""
    root = Element("qgis", {"version": "3.34"})
    values = {"type": "dataset", "title": about.title, "abstract": about.abstract}
    for name, value in values.items():
        SubElement(root, name).text = value
    return f"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n{tostring(root).decode()}"


def add_styles(
    database: sqlite3.Connection, styles: Mapping[str, str], *, name: str, about: str
) -> None:
    """Give layers of a GeoPackage that has no styles yet their default style.

    Parameters
    ----------
    database : sqlite3.Connection
        The GeoPackage.
    styles : mapping
        QML by layer.
    name, about : str
        Name and description of the styles, in a few words.
    """
    database.execute(_CREATE_STYLES)
    database.execute(_ADD_STYLES_TABLE, (_FILE_TIME,))
    for layer, qml in styles.items():
        database.execute(_ADD_STYLE, (name, qml, "", about, _owner(qml), _FILE_TIME, layer))


def style_layers(
    path: Path, styles: Mapping[str, str], *, name: str, about: str,
    notes: Mapping[str, LayerNotes] | None = None,
) -> None:  # fmt: skip
    """Write titles, meaning and default styles of layers of a GeoPackage that GDAL has written.

    Parameters
    ----------
    path : Path
        The GeoPackage.
    styles, name, about
        As :func:`add_styles` takes them; without a style, no table of styles is made.
    notes : mapping, optional
        As :func:`describe_layers` takes them.
    """
    with closing(sqlite3.connect(path)) as database, database:
        if notes is not None:
            describe_layers(database, notes)
        if styles:
            add_styles(database, styles, name=name, about=about)


def copy_saved_styles(path: Path, *, earlier: Path) -> None:
    """Copy the styles that users saved in a GeoPackage to the new one that replaces it.

    A layer's default style stays its default; a style of ours that nobody changed is not copied.

    Parameters
    ----------
    path : Path
        The new GeoPackage, with styles of ours.
    earlier : Path
        The GeoPackage that it replaces, which need not be there.

    Raises
    ------
    OutputError
        If another program writes the earlier one: what it has not saved yet would be lost.
    """
    if not earlier.is_file():
        return
    _refuse_locked(earlier)
    columns = "f_table_name, styleName, styleQML, styleSLD, description, useAsDefault, owner"
    query = f"SELECT {columns} FROM layer_styles ORDER BY id"  # noqa: S608 - our own names
    with closing(sqlite3.connect(path)) as database, database:
        try:
            with read_only(earlier) as old:
                saved = old.execute(query).fetchall()
        except sqlite3.Error:
            return
        for layer, name, qml, sld, about, default, owner in saved:
            if owner == _owner(str(qml)):
                continue  # as we wrote it
            if default:
                database.execute(
                    "UPDATE layer_styles SET useAsDefault = 0 WHERE f_table_name = ?", (layer,)
                )
            database.execute(_ADD_STYLE, (name, qml, sld, about, owner, _FILE_TIME, layer))
            database.execute(
                "UPDATE layer_styles SET useAsDefault = ? WHERE id = last_insert_rowid()",
                (bool(default),),
            )


def _refuse_locked(path: Path) -> None:
    """Refuse to replace a GeoPackage that another program writes; readers do not matter."""
    uri = f"{path.resolve().as_uri()}?mode=rw"
    try:
        with closing(sqlite3.connect(uri, uri=True, timeout=LOCK_WAIT_S)) as database:
            database.execute("BEGIN IMMEDIATE")
            database.execute("ROLLBACK")
    except sqlite3.Error as error:
        if _LOCKED in str(error):
            raise OutputError("{}: another program has it locked", path, hint=_HELD_HINT) from error


def _owner(qml: str) -> str:
    """Return the `owner` of a style of ours: with its digest, so that a changed one is noticed."""
    return f"gis_radar {hashlib.blake2b(qml.encode(), digest_size=8).hexdigest()}"


def read_only(path: Path) -> closing[sqlite3.Connection]:
    """Return a connection to a GeoPackage that only reads, for a `with`."""
    return closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True))


_VIEWER_TABLES = {"layer_styles", "qgis_projects", "gpkg_ogr_contents"}
_DATED_TABLES = {"gpkg_contents", "gpkg_metadata_reference"}


def content_digest(path: Path, exclude: Collection[str] = ()) -> str | None:
    """Return a digest of the tables of a GeoPackage; None where it cannot be read.

    Left out are what viewers write (order of pages, counters, styles), the file's dates, and the
    layers `exclude`.
    """
    digest = hashlib.blake2b(digest_size=16)
    try:
        with read_only(path) as database:
            query = "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
            for (name,) in database.execute(query).fetchall():
                if name not in {*_VIEWER_TABLES, *_DATED_TABLES, *exclude} and not name.startswith(
                    ("rtree_", "sqlite_")
                ):
                    _add_table(digest, database, name)
    except sqlite3.Error:
        return None
    return digest.hexdigest()


def _add_table(digest: Any, database: sqlite3.Connection, name: str) -> None:
    """Add the columns of a table, without those that are computed, to a digest, row by row."""
    stored = [row[1] for row in database.execute(f'PRAGMA table_xinfo("{name}")') if not row[6]]
    listed = ", ".join(f'"{column}"' for column in stored)
    rows = database.execute(f'SELECT {listed} FROM "{name}"')  # noqa: S608 - of the file itself
    digest.update(repr((name, stored)).encode())
    while batch := rows.fetchmany(4096):
        digest.update(marshal.dumps(batch, 2))  # 2: no references, so equal rows give equal bytes


_writing = Lock()


@contextmanager
def _fixed_date() -> Iterator[None]:
    """Make GDAL write a fixed date within the block; one thread writes at a time."""
    with _writing:
        earlier = pyogrio.get_gdal_config_option(_GDAL_DATE_OPTION)
        pyogrio.set_gdal_config_options({_GDAL_DATE_OPTION: _FILE_TIME})
        try:
            yield
        finally:
            pyogrio.set_gdal_config_options({_GDAL_DATE_OPTION: earlier})


def add_layer(table: gpd.GeoDataFrame, path: Path, layer: str, **options: Any) -> None:
    """Write a table as a layer of a GeoPackage, beside those that it has.

    Parameters
    ----------
    table : GeoDataFrame
        The layer.
    path : Path
        The file, which need not be there.
    layer : str
        Name of the layer.
    **options
        As for :func:`pyogrio.write_dataframe`.
    """
    _refuse_archive(path)
    with _fixed_date():
        pyogrio.write_dataframe(
            table, path, layer=layer, driver="GPKG", append=path.exists(),
            dataset_options={"VERSION": _GPKG_VERSION}, **options,
        )  # fmt: skip


def _refuse_archive(path: Path) -> None:
    """Raise where GDAL would write elsewhere, or not at all."""
    if _is_in_archive(place := path.resolve()):
        if not str(place).isprintable():
            raise OSError(_LINE_BREAK)
        raise OSError(
            "its name, or its folder's, stands for a file in an archive: no ! and no .zip"
        )


def write_stream(
    batches: Iterable[pa.RecordBatch], schema: pa.Schema, path: Path, **options: Any
) -> None:
    """Write batches as a layer of a new GeoPackage; an error that ends them is raised unchanged.

    Parameters
    ----------
    batches : iterable of pyarrow.RecordBatch
        All of `schema`, the geometry as WKB.
    schema : pyarrow.Schema
        The columns.
    path : Path
        The file.
    **options
        As for :func:`pyogrio.write_arrow`.
    """
    _refuse_archive(path)
    errors: list[BaseException] = []
    reader = pa.RecordBatchReader.from_batches(schema, _recording_error(batches, errors))
    try:
        with _fixed_date():
            pyogrio.write_arrow(
                reader, path, driver="GPKG", dataset_options={"VERSION": _GPKG_VERSION}, **options
            )
    except Exception:
        if not errors:
            raise
    if errors:
        raise errors[0]


def _recording_error(
    batches: Iterable[pa.RecordBatch], errors: list[BaseException]
) -> Iterator[pa.RecordBatch]:
    """Yield the batches; add the error that ends them to `errors`, as Arrow would hide a Ctrl-C."""
    try:
        yield from batches
    except (Exception, KeyboardInterrupt) as error:
        errors.append(error)
        raise
