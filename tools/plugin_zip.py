"""Build the zip of the QGIS plugin: its files, completed metadata, and the worker's wheel.

    python tools/plugin_zip.py [--wheel dist/gis_radar-X.whl] [-o dist]

Version and addresses come from pyproject.toml. The same files give the same bytes.
"""

from __future__ import annotations

import argparse
import configparser
import io
import re
import tomllib
import zipfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
NAME = "gis_radar_plugin"
SOURCE = ROOT / "qgis_plugin" / NAME
KINDS = (".py", ".svg", ".json")  # suffixes of the plugin's files
# Files of the package that the plugin uses, too.
SHARED = (
    "products/heatmap/ground.qml",
    "base/languages/po.py",
    "base/languages/de/LC_MESSAGES/gis_radar.po",
)
REQUIRED = (
    "name", "qgisMinimumVersion", "description", "about", "version", "author", "email",
    "repository", "tracker",
)  # fmt: skip
MOST_BYTES = 25_000_000  # of a zip that QGIS's plugin repository accepts
_EPOCH = (1980, 1, 1, 0, 0, 0)


def project() -> dict[str, Any]:
    """Return the table `project` of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    found: dict[str, Any] = tomllib.loads(text)["project"]
    return found


def metadata() -> str:
    """Return the plugin's metadata, completed from pyproject.toml and CHANGELOG.md.

    Raises
    ------
    SystemExit
        If a field is missing that QGIS's plugin repository requires.
    """
    known = project()
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(SOURCE / "metadata.txt", encoding="utf-8")
    fields = parser["general"]
    fields["version"] = known["version"]
    urls = {name.lower(): url for name, url in known.get("urls", {}).items()}
    for field, name in (("repository", "repository"), ("tracker", "issues"),
                        ("homepage", "homepage")):  # fmt: skip
        if url := urls.get(name, urls.get("repository")):
            fields.setdefault(field, url)
    if "example.org" in "".join(fields.values()):
        print("plugin-zip: put the real addresses into pyproject.toml and metadata.txt to publish")
    fields["changelog"] = _changes(known["version"])
    missing = [field for field in REQUIRED if not fields.get(field)]
    if missing:
        raise SystemExit(f"plugin-zip: metadata.txt lacks {', '.join(missing)}")
    text = io.StringIO()
    parser.write(text, space_around_delimiters=False)
    return text.getvalue()


def _changes(version: str) -> str:
    """Return the change log of a version as a value of several lines."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    found = re.search(
        rf"^## {re.escape(version)}\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE
    )
    lines = found.group(1).strip().splitlines() if found else []
    return "\n".join([version, *[line for line in lines if line.strip()]])


def files(wheel: Path | None) -> dict[str, bytes]:
    """Return the contents of the zip by file name in the plugin's folder."""
    found = {
        path.relative_to(SOURCE).as_posix(): path.read_bytes()
        for path in sorted(SOURCE.rglob("*"))
        if path.suffix in KINDS and "__pycache__" not in path.parts
    }
    for name in SHARED:
        found[f"resources/{name}"] = (ROOT / "gis_radar" / name).read_bytes()
    found["metadata.txt"] = metadata().encode()
    found["LICENSE"] = (ROOT / "LICENSE").read_bytes()
    if wheel is not None:
        if project()["version"] not in wheel.name:
            raise SystemExit(f"plugin-zip: {wheel.name} is not of version {project()['version']}")
        found[f"worker/{wheel.name}"] = wheel.read_bytes()
        found["worker/constraints.txt"] = (ROOT / "constraints.txt").read_bytes()
    return found


def build(folder: Path, wheel: Path | None) -> Path:
    """Write the zip and return its path.

    Raises
    ------
    SystemExit
        If it is larger than QGIS's plugin repository accepts.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{NAME}-{project()['version']}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files(wheel).items():
            entry = zipfile.ZipInfo(f"{NAME}/{name}", _EPOCH)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
    if path.stat().st_size > MOST_BYTES:
        raise SystemExit(f"plugin-zip: {path} is larger than {MOST_BYTES / 1e6:.0f} MB")
    return path


def main() -> None:
    """Build from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--wheel", type=Path, help="of gis_radar, for 'Set up the worker'")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist")
    given = parser.parse_args()
    made = build(given.output, given.wheel)
    print("plugin-zip: in QGIS Plugins, Manage and Install Plugins, Install from ZIP:")
    print(made.resolve())


if __name__ == "__main__":
    main()
