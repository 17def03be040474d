"""Put the tables of a dataset, from their schema, into docs/dataset.md: no options."""

from __future__ import annotations

import sys
from pathlib import Path

from gis_radar.dataset import TableSchema
from gis_radar.dataset.files.schema import TableColumn
from gis_radar.dataset.files.tables import TABLES

sys.path.append(str(Path(__file__).parents[1] / "bench"))
import pages

ROOT = Path(__file__).parents[1]
PERIODS = {
    "hour": "a file an hour, `{}/date=YYYY-MM-DD/HH.parquet`",
    "day": "a file a day, `{}/date=YYYY-MM-DD/day.parquet`",
    "month": "a file a month, `{}/month=YYYY-MM/month.parquet`",
    "dataset": "one file, `{}.parquet`",
}


def tables() -> str:
    """Return a section for each table of the schema."""
    return "\n\n".join(_section(table) for table in TABLES.values())


def _section(table: TableSchema) -> str:
    order = ", ".join(f"`{name}`" for name in table.order)
    period = PERIODS[table.period].format(table.name)
    head = [f"### `{table.name}`", f"A row is {table.means}; sorted by {order}; {period}.", ""]
    rows = [_row(column) for column in table.columns]
    return "\n".join(["", *head, "| column | type | meaning |", "|---|---|---|", *rows]).lstrip()


def _row(column: TableColumn) -> str:
    kind = str(column.type).replace("list<item: int64>", "list of int64")
    kind = {"string": "text", "double": "float64", "float": "float32"}.get(kind, kind)
    return f"| `{column.name}` | {kind} | {column.means} |"


if __name__ == "__main__":
    pages.put(ROOT / "docs" / "dataset.md", {"tables": tables()})
