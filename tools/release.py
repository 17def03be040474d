"""Complete a release in dist: the documentation as a zip, what each file is for, and checksums.

    python tools/release.py

`make release` builds wheel, source distribution, plugin and documentation before. Files of other
versions in dist are refused, so that none is published.
"""

from __future__ import annotations

import hashlib
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
DIST, DOCS = ROOT / "dist", ROOT / "out" / "docs" / "html"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the same files give the same zip


def main() -> int:
    """Write the missing files of dist, and print what each file is for."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    purposes = {
        f"gis_radar-{version}-py3-none-any.whl": "the Python package: `pip install` it",
        f"gis_radar-{version}.tar.gz": "its sources, for packagers",
        f"gis_radar_plugin-{version}.zip": (
            "the QGIS plugin, with the package in it: *Plugins*, *Install from ZIP*"
        ),
        f"gis_radar-docs-{version}.zip": "the documentation: open `index.html`, no network needed",
    }
    *built, docs = purposes
    if not (DOCS / "index.html").is_file():
        print(f"{DOCS}: no documentation; build it by make docs", file=sys.stderr)
        return 1
    _zip_documentation(DIST / docs)
    ours = {*purposes, "FILES.md", "SHA256SUMS"}
    missing = [name for name in built if not (DIST / name).is_file()]
    others = sorted({path.name for path in DIST.glob("[!.]*") if path.is_file()} - ours)
    if missing or others:
        print(f"dist: missing {missing}, of something else {others}", file=sys.stderr)
        return 1
    rows = [f"| `{name}` | {purpose} |" for name, purpose in purposes.items()]
    table = "\n".join(["| file | what it is for |", "|---|---|", *rows]) + "\n"
    (DIST / "FILES.md").write_text(table, encoding="utf-8")
    sums = [
        f"{hashlib.sha256((DIST / name).read_bytes()).hexdigest()}  {name}" for name in purposes
    ]
    (DIST / "SHA256SUMS").write_text("\n".join(sums) + "\n", encoding="utf-8")
    print(table, end="")
    return 0


def _zip_documentation(target: Path) -> None:
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(each for each in DOCS.rglob("*") if each.is_file()):
            entry = zipfile.ZipInfo(str(path.relative_to(DOCS)), _EPOCH)
            archive.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED)


if __name__ == "__main__":
    sys.exit(main())
