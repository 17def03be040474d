"""SQL over the tables of a dataset: one SELECT, without files, network or settings (DuckDB)."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, TypeAlias

import duckdb
import pyarrow as pa

from gis_radar.base import QUIET, InputError, Reporter, Text, UsageError, first_line
from gis_radar.dataset.files.parts import MEASURE_AGAIN
from gis_radar.dataset.files.records import HOURS
from gis_radar.dataset.files.source import DatasetFiles
from gis_radar.dataset.files.tables import TABLES
from gis_radar.dataset.questions.views import LAYERS, quoted, views_of_sites

_ASKABLE = (*TABLES, *LAYERS)
_ASK_ONE = Text("ask one SELECT of the tables {}", ", ".join(_ASKABLE))
# Allowed nodes of a parsed query; others may write: DuckDB takes COPY in a WITH, to any file.
_NODES = {"SELECT_NODE", "SET_OPERATION_NODE", "RECURSIVE_CTE_NODE", "CTE_NODE"}
_TABLE_FUNCTIONS = {"range", "generate_series", "unnest"}
_NO_FUNCTIONS = {"current_setting", "getvariable", "write_log"}


def tables_of(connection: duckdb.DuckDBPyConnection, sql: str) -> set[str]:
    """Return the names of the tables that a query reads.

    Parameters
    ----------
    connection : duckdb.DuckDBPyConnection
        Connection that parses the query.
    sql : str
        The query.

    Raises
    ------
    UsageError
        If it is no single SELECT, or reads anything but tables of a dataset.
    """
    nodes = list(_nodes(_tree(connection, sql)))
    ctes = {
        each["key"].lower() for node in nodes for each in node.get("cte_map", {}).get("map", ())
    }
    tables: set[str] = set()
    for node in nodes:
        _refuse_forbidden(node)
        kind, name = node.get("type"), str(node.get("table_name", "")).lower()
        if kind == "BASE_TABLE" and name in _ASKABLE:
            tables.add(name)
        elif (kind == "BASE_TABLE" and name not in ctes) or (kind == "SHOW_REF" and name):
            raise UsageError(
                "the query names {}, which is no table here", repr(name), hint=_ASK_ONE
            )
    return tables


def _tree(connection: duckdb.DuckDBPyConnection, sql: str) -> Any:
    try:
        ((answer,),) = connection.execute("SELECT json_serialize_sql(?)", [sql]).fetchall()
        tree = json.loads(answer)
    except (duckdb.Error, ValueError, RecursionError) as error:
        raise UsageError(
            "the query cannot be read: {}", first_line(error), hint=_ASK_ONE
        ) from error
    if tree.get("error_type") == "not implemented":
        raise UsageError("the query is no SELECT", hint=_ASK_ONE)
    if tree["error"]:
        raise UsageError("the query cannot be read: {}", tree["error_message"], hint=_ASK_ONE)
    if (count := len(tree["statements"])) != 1:
        raise UsageError("the query has {} statements, one is needed", count, hint=_ASK_ONE)
    return tree


def _nodes(tree: Any) -> Iterator[dict[str, Any]]:
    """Yield all objects in a JSON document."""
    waiting = [tree]
    while waiting:
        each = waiting.pop()
        if isinstance(each, dict):
            yield each
            waiting += each.values()
        elif isinstance(each, list):
            waiting += each


def _refuse_forbidden(node: dict[str, Any]) -> None:
    """Refuse nodes that are no SELECT, and functions that reach beyond the tables."""
    kind, function = str(node.get("type")), node.get("function")
    if kind.endswith("_NODE") and kind not in _NODES:
        what = kind.partition("_")[0]
        raise UsageError("the query holds {}, which could write", what, hint=_ASK_ONE)
    called = function.get("function_name") if isinstance(function, dict) else None
    name = node.get("function_name")
    if (kind == "TABLE_FUNCTION" and called not in _TABLE_FUNCTIONS) or name in _NO_FUNCTIONS:
        raise UsageError(
            "the query calls {}, which reaches out of the tables", called or name, hint=_ASK_ONE
        )


Answer: TypeAlias = tuple[pa.Schema, Iterator[pa.RecordBatch]]
"""The columns of an answer, and its rows in batches."""
_PROPOSAL = ("Candidate bindings:", "Did you mean")
_ROWS_AT_ONCE = 1 << 17  # rows of a batch of an answer
_CONFIG = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "allow_community_extensions": "false",
    "python_enable_replacements": "false",
    "temp_directory": "",
}


@contextmanager
def run_query(
    folder: Path,
    sites: Mapping[str, DatasetFiles],
    sql: str,
    *,
    timeout_s: float,
    memory: str,
    reporter: Reporter = QUIET,
) -> Iterator[Answer]:
    """Run an SQL query, and read the answer in batches.

    The tables have the columns of the files, and `time`, `begin`, `end`, `easting`, `northing`,
    `heading`, `speed`, `s_m` and `d_m` as the methods of the dataset return them; of several sites,
    `site` before them. Times are by the clocks of the sites: `hour(begin)` is an hour there; of
    sites in several time zones, they are UTC.

    Parameters
    ----------
    folder : Path
        Folder of the dataset or city, for messages.
    sites : mapping
        Datasets, of which complete hours are read, by the names of their sites; one dataset alone
        by an empty name.
    sql : str
        One SELECT.
    timeout_s : float
        Time limit, seconds.
    memory : str
        Memory limit, such as `2GB`.
    reporter : Reporter
        Receives a warning where parts of a table were deleted.

    Yields
    ------
    pyarrow.Schema, iterator of pyarrow.RecordBatch
        The answer, to be read within the block.

    Raises
    ------
    UsageError
        If it is no such query, takes too long, or needs too much memory.
    InputError
        If a part is not the one of its hour's record, or hours were made again meanwhile.
    """
    with closing(_connect(memory)) as connection:
        names = tables_of(connection, sql)
        before = [_states(each.folder) for each in sites.values()]
        zones = {each.manifest.timezone for each in sites.values()}
        zone = zones.pop() if len(zones) == 1 else "UTC"
        with _errors_of(folder):
            _lock(connection, views_of_sites(sites, connection, names, reporter), zone)
        with ThreadPoolExecutor(1) as thread:
            query = _InterruptibleQuery(connection, thread, folder, timeout_s)
            answer = query.result_of(lambda: connection.sql(sql).to_arrow_reader(_ROWS_AT_ONCE))
            _refuse_same_names(answer.schema.names)
            yield answer.schema, query.batches(answer)
    if [_states(each.folder) for each in sites.values()] != before:
        raise InputError("{}: hours were made again meanwhile", folder, hint="ask again")


@dataclass(frozen=True)
class _InterruptibleQuery:
    """A query on its own thread, so that it can be interrupted at any moment."""

    connection: duckdb.DuckDBPyConnection
    thread: ThreadPoolExecutor
    folder: Path
    timeout_s: float
    began: float = field(default_factory=monotonic)

    def batches(self, answer: pa.RecordBatchReader) -> Iterator[pa.RecordBatch]:
        """Yield the batches of an answer."""
        while (batch := self.result_of(lambda: next(answer, None))) is not None:
            yield batch

    def result_of(self, step: Callable[[], Any]) -> Any:
        """Return the result of a step, within the time limit, with errors converted to ours."""
        future = self.thread.submit(step)
        try:
            wait([future], max(self.began + self.timeout_s - monotonic(), 0.0))
        finally:
            is_late = self._end(future)
        if is_late:
            raise UsageError(
                "the query was given up after {:g} s",
                self.timeout_s,
                hint="ask for less, or raise --timeout",
            )
        with _errors_of(self.folder):
            return future.result()

    def _end(self, future: Future[Any]) -> bool:
        """Interrupt a future that is not done; return whether that was needed."""
        is_late = not future.done()
        while not future.done():  # an interrupt before DuckDB has begun has no effect
            self.connection.interrupt()
            wait([future], 0.05)
        return is_late


def _connect(memory: str) -> duckdb.DuckDBPyConnection:
    try:
        return duckdb.connect(":memory:", config={**_CONFIG, "memory_limit": memory})
    except duckdb.Error as error:
        raise UsageError("memory is {}", repr(memory), hint="e.g. 500MB, 2GB") from error


def _refuse_same_names(names: list[str]) -> None:
    """Refuse an answer with two columns of one name, which files and JSON cannot hold."""
    if twice := [name for place, name in enumerate(names) if name in names[:place]]:
        raise UsageError("the query has two columns {}", repr(twice[0]), hint="name one with AS")


def _lock(connection: duckdb.DuckDBPyConnection, paths: list[Path], timezone: str) -> None:
    """Restrict DuckDB to the files of the tables, and lock its settings."""
    files = ", ".join(quoted(path.resolve().as_posix()) for path in paths)
    for setting in (
        f"allowed_paths = [{files}]", "enable_external_access = false",
        f"TimeZone = {quoted(timezone)}", "lock_configuration = true",
    ):  # fmt: skip
        connection.execute(f"SET {setting}")


def _states(folder: Path) -> list[tuple[str, int, int]]:
    """Return path, time of writing and inode of each hour's record, to notice changes."""
    states = []
    for path in sorted((folder / HOURS).glob("*/*.json")):
        with suppress(FileNotFoundError):
            state = path.stat()
            states.append((str(path), state.st_mtime_ns, state.st_ino))
    return states


@contextmanager
def _errors_of(folder: Path) -> Iterator[None]:
    """Convert errors of DuckDB, also those that Arrow passes on, to ours."""
    try:
        yield
    except (duckdb.Error, pa.ArrowException, OSError) as error:
        if "Out of Memory" in str(error):
            raise UsageError(
                "the query needs more memory than it may take",
                hint="ask for less, or raise --memory",
            ) from error
        # errors of the query are of a class of their own, those of damaged pages of none
        damaged = isinstance(error, duckdb.IOException) or type(error) is duckdb.Error
        if damaged or ".parquet" in str(error):
            raise InputError("{}: {}", folder, first_line(error), hint=MEASURE_AGAIN) from error
        raise UsageError(
            "the query fails: {}", _first_line_and_proposals(error), hint=_ASK_ONE
        ) from error


def _first_line_and_proposals(error: Exception) -> str:
    """Return the first line of an error of DuckDB, and the names that it proposes."""
    proposed = [line for line in str(error).splitlines()[1:] if line.startswith(_PROPOSAL)]
    return "; ".join([first_line(error), *proposed])
