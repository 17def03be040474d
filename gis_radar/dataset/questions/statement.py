"""Check an SQL query: one SELECT over the tables of a dataset, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import duckdb

from gis_radar.base import Text, UsageError, first_line
from gis_radar.dataset.files.tables import TABLES

LAYERS = ("tiles", "lanes", "stop_lines")
_ASKABLE = (*TABLES, *LAYERS)
ASK_ONE = Text("ask one SELECT of the tables {}", ", ".join(_ASKABLE))
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
            raise UsageError("the query names {}, which is no table here", repr(name), hint=ASK_ONE)
    return tables


def _tree(connection: duckdb.DuckDBPyConnection, sql: str) -> Any:
    try:
        ((answer,),) = connection.execute("SELECT json_serialize_sql(?)", [sql]).fetchall()
        tree = json.loads(answer)
    except (duckdb.Error, ValueError, RecursionError) as error:
        raise UsageError("the query cannot be read: {}", first_line(error), hint=ASK_ONE) from error
    if tree.get("error_type") == "not implemented":
        raise UsageError("the query is no SELECT", hint=ASK_ONE)
    if tree["error"]:
        raise UsageError("the query cannot be read: {}", tree["error_message"], hint=ASK_ONE)
    if (count := len(tree["statements"])) != 1:
        raise UsageError("the query has {} statements, one is needed", count, hint=ASK_ONE)
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
        raise UsageError("the query holds {}, which could write", what, hint=ASK_ONE)
    called = function.get("function_name") if isinstance(function, dict) else None
    name = node.get("function_name")
    if (kind == "TABLE_FUNCTION" and called not in _TABLE_FUNCTIONS) or name in _NO_FUNCTIONS:
        raise UsageError(
            "the query calls {}, which reaches out of the tables", called or name, hint=ASK_ONE
        )
