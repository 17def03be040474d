"""The schema of a site file as texts: a template to fill in, and the reference."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import Field
from typing import Any

from gis_radar.site.schema import TableKind, is_required, keys_of
from gis_radar.site.site import Site

_HEAD = """\
# A site of gis_radar. Lines without # must be filled in; the others show what else there is.
# Paths are relative to the folder of this file. Positions are metres of the map frame.
# Then: gis-radar run SITE.toml -o results
"""
_WIDTH = 96
_GIVEN = {("scan", "files"), ("sensor", "guess")}  # one of several keys that will do


def site_template() -> str:
    """Return a commented site file to fill in."""
    return "\n".join([_HEAD, *_template(Site, "")]).rstrip() + "\n"


def _template(kind: Any, path: str) -> Iterator[str]:
    """Yield the lines of a table: first its keys, then the tables below it."""
    below = []
    for name, each in keys_of(kind).items():
        if isinstance(each.metadata["kind"], TableKind):
            below.append((name, each))
            continue
        needed = is_required(each) or (path, name) in _GIVEN
        yield from textwrap.wrap(_said(each), _WIDTH, initial_indent="# ", subsequent_indent="# ")
        yield f"{'' if needed else '# '}{name} = {each.metadata['example']}"
    yield ""
    for name, each in below:
        whole = f"{path}.{name}" if path else name
        table: TableKind = each.metadata["kind"]
        off = "# " if whole.startswith("sensor.") else ""
        yield f"{off}{_header(whole, table)}  # {each.metadata['meaning']}"
        yield from _template(table.table, whole)


def _header(path: str, kind: TableKind) -> str:
    return f"[[{path}]]" if kind.repeated else f"[{path}]"


def _said(each: Field[Any]) -> str:
    return f"{each.metadata['meaning']} ({each.metadata['kind'].says}; {_default(each)})"


def _default(each: Field[Any]) -> str:
    if is_required(each):
        return "required"
    shown = each.metadata["shown"]
    return f"default {each.default if shown is None else shown}"


def site_reference() -> str:
    """Return the reference of all keys as Markdown: a table of keys for each table of the file."""
    return "\n".join(_reference(Site, "", "At the top")).rstrip() + "\n"


def _reference(kind: Any, path: str, title: str) -> Iterator[str]:
    below = []
    yield from (f"### {title}", "", "| key | value | what it is |", "|---|---|---|")
    for name, each in keys_of(kind).items():
        if isinstance(each.metadata["kind"], TableKind):
            below.append((name, each))
            continue
        says = each.metadata["kind"].says.replace("|", "\\|").replace("*", "\\*")
        meaning = each.metadata["meaning"].replace("|", "\\|")
        yield f"| `{name}` | {says}; {_default(each)} | {meaning} |"
    yield ""
    for name, each in below:
        whole = f"{path}.{name}" if path else name
        table: TableKind = each.metadata["kind"]
        yield from _reference(table.table, whole, f"`{_header(whole, table)}`")
