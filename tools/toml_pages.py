"""Put the keys of site files and edge files, from their models, at the end of their pages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gis_radar.live.wire.settings import EdgeFile
from gis_radar.site import Site, TomlTable
from gis_radar.site.toml_file import default_of, header_of, keys_and_subtables
from gis_radar.site.values import value_of

DOCS = Path(__file__).parents[1] / "docs"
PAGES: dict[Path, type[TomlTable]] = {
    DOCS / "site-file.md": Site,
    DOCS / "live.md": EdgeFile,
}
TOP = "### At the top\n"


def reference(root: type[TomlTable]) -> str:
    """Return all keys of a file as Markdown: a table of keys for each of its tables."""
    return TOP + "\n".join(_lines(root, "")).rstrip() + "\n"


def _lines(table: type[TomlTable], path: str) -> Iterator[str]:
    """Yield the lines of a table and of those below it, without its title."""
    keys, subtables = keys_and_subtables(table, path)
    yield from ("", "| key | value | what it is |", "|---|---|---|")
    for name, field in keys.items():
        value = value_of(field).replace("|", "\\|").replace("*", "\\*")
        meaning = (field.description or "").replace("|", "\\|")
        yield f"| `{name}` | {value}; {default_of(field)} | {meaning} |"
    yield ""
    for inner_path, field, inner in subtables:
        yield f"### `{header_of(inner_path, field)}`"
        yield from _lines(inner, inner_path)


if __name__ == "__main__":
    for page, root in PAGES.items():
        before, _, _ = page.read_text(encoding="utf-8").partition(TOP)
        page.write_text(before + reference(root), encoding="utf-8")
