"""The template of a site file and the reference of its keys, from the fields of the models."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from pydantic.fields import FieldInfo

from gis_radar.site.settings import Site, TomlTable, is_repeated, table_of, value_of

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


def _template(table: type[TomlTable], path: str) -> Iterator[str]:
    """Yield the lines of a table: first its keys, then the tables below it."""
    keys, below = _parts(table)
    for name, field in keys.items():
        needed = field.is_required() or (path, name) in _GIVEN
        text = f"{field.description} ({value_of(field)}; {_default(field)})"
        yield from textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
        yield f"{'' if needed else '# '}{name} = {(field.examples or [''])[0]}"
    yield ""
    for name, (field, inner) in below.items():
        whole = f"{path}.{name}" if path else name
        off = "# " if whole.startswith("sensor.") else ""
        yield f"{off}{_header(whole, field)}  # {field.description}"
        yield from _template(inner, whole)


def site_reference() -> str:
    """Return the reference of all keys as Markdown: a table of keys for each table of the file."""
    return "\n".join(_reference(Site, "", "At the top")).rstrip() + "\n"


def _reference(table: type[TomlTable], path: str, title: str) -> Iterator[str]:
    keys, below = _parts(table)
    yield from (f"### {title}", "", "| key | value | what it is |", "|---|---|---|")
    for name, field in keys.items():
        value = value_of(field).replace("|", "\\|").replace("*", "\\*")
        meaning = (field.description or "").replace("|", "\\|")
        yield f"| `{name}` | {value}; {_default(field)} | {meaning} |"
    yield ""
    for name, (field, inner) in below.items():
        whole = f"{path}.{name}" if path else name
        yield from _reference(inner, whole, f"`{_header(whole, field)}`")


def _parts(
    table: type[TomlTable],
) -> tuple[dict[str, FieldInfo], dict[str, tuple[FieldInfo, type[TomlTable]]]]:
    """Return the keys of a table, and the tables below it."""
    fields = table.model_fields
    below = {name: (field, inner) for name, field in fields.items() if (inner := table_of(field))}
    return {name: field for name, field in fields.items() if name not in below}, below


def _header(path: str, field: FieldInfo) -> str:
    return f"[[{path}]]" if is_repeated(field) else f"[{path}]"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    extra = field.json_schema_extra
    shown = extra.get("shown") if isinstance(extra, dict) else None
    return f"default {field.default if shown is None else shown}"
