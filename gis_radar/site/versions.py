"""The software that made results: versions of libraries, and a hash of our own code."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

LIBRARIES = (
    "numpy", "scipy", "pandas", "geopandas", "shapely", "pyogrio", "pyproj", "pyarrow",
    "rasterio", "laspy", "lazrs", "numba", "matplotlib", "open3d",
)  # fmt: skip


@cache
def software() -> dict[str, str]:
    """Return the versions of all software that results depend on.

    The entry `code` is the hash of our own modules, as a checkout changes without a new version.
    """
    code = hashlib.blake2b(digest_size=8)
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        code.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return {
        "gis_radar": version("gis_radar"),
        "code": code.hexdigest(),
        "python": platform.python_version(),
        **{name: found for name in LIBRARIES if (found := _version(name))},
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""
