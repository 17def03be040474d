"""Databases of the live system: whether one is whole, and changes that are made as a whole."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

# What SQLite says where nothing is wrong with the file: it is in use, or the disk is full or away.
_OF_THE_PLACE = ("BUSY", "LOCKED", "FULL", "IOERR", "READONLY", "CANTOPEN", "NOMEM", "PERM", "AUTH")
LAST_NUMBER = 1 << 62  # there is room for the next ones in 64 bits


@contextmanager
def as_one(database: sqlite3.Connection) -> Iterator[None]:
    """Bring what is written inside to the disk as a whole, or not at all."""
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        if database.in_transaction:
            database.execute("ROLLBACK")
        raise


def is_damage(error: sqlite3.Error) -> bool:
    """Return whether an error of SQLite is about what the file holds."""
    name = getattr(error, "sqlite_errorname", "SQLITE_ERROR").removeprefix("SQLITE_")
    return not name.startswith(_OF_THE_PLACE)


def damage_of(
    database: sqlite3.Connection, columns: Mapping[str, Sequence[str]], sound: Mapping[str, str]
) -> str:
    """Return what is wrong with a database, or nothing; its whole content is read.

    Parameters
    ----------
    database : Connection
        With all tables that should be there.
    columns : mapping
        Of each table.
    sound : mapping
        By table what holds of each row, in SQL.

    Raises
    ------
    sqlite3.Error
        If it is in use, or its place cannot be read.
    """
    try:
        (found,) = database.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            return "its pages do not fit together"
        for table, names in columns.items():
            query = "SELECT name FROM pragma_table_info(?)"
            if [name for (name,) in database.execute(query, (table,))] != list(names):
                return f"the columns of {table} are not {', '.join(names)}"
        for table, holds in sound.items():
            query = f"SELECT count(*) FROM {table} WHERE NOT coalesce({holds}, 0)"  # noqa: S608 - ours
            (odd,) = database.execute(query).fetchone()
            if odd:
                return f"{odd} rows of {table} cannot be"
    except (sqlite3.Error, UnicodeDecodeError) as error:
        if isinstance(error, sqlite3.Error) and not is_damage(error):
            raise
        return "it cannot be read"
    return ""


def is_foreign(database: sqlite3.Connection, ours: Sequence[str]) -> bool:
    """Return whether a database holds tables that are not ours.

    Parameters
    ----------
    database : Connection
        Of any file.
    ours : sequence of str
        The tables that ours has.

    Raises
    ------
    sqlite3.Error
        If it cannot be read.
    """
    query = "SELECT name FROM sqlite_master WHERE type = 'table'"
    return bool({name for (name,) in database.execute(query)} - {*ours})
