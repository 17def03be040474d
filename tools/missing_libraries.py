"""Find system libraries that Python packages need and this machine lacks.

``missing_libraries.py run`` (or ``dev``, ``bench``) prints what to install for the libraries that
are known to be needed: Debian's packages where there is apt, else the names of the libraries. It
runs on a bare Python. With ``--load`` it runs in the finished environment: it loads every package
and all of gis_radar, starts every program, and says what fails.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib
import importlib.metadata
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

# Debian's package by library. PyPI's wheels contain all other libraries.
RUN_LIBRARIES = {
    "libexpat.so.1": "libexpat1",  # rasterio, pyogrio
    "libz.so.1": "zlib1g",
    "libstdc++.so.6": "libstdc++6",
    "libpango-1.0.so.0": "libpango-1.0-0",  # these are WeasyPrint's
    "libpangoft2-1.0.so.0": "libpangoft2-1.0-0",
    "libharfbuzz-subset.so.0": "libharfbuzz-subset0",
}
DEV_LIBRARIES = {
    "libatomic.so.1": "libatomic1",  # these are SUMO's
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
}
BENCH_LIBRARIES = {
    "libEGL.so.1": "libegl1",  # these are Open3D's
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
}
LIBRARIES = {
    "run": RUN_LIBRARIES,
    "dev": RUN_LIBRARIES | DEV_LIBRARIES,
    "bench": RUN_LIBRARIES | DEV_LIBRARIES | BENCH_LIBRARIES,
}
DEV_PROGRAMS = ("sumo/bin/sumo", "sumo/bin/netconvert", "sumo/bin/netgenerate")


def main() -> None:
    """Print what is missing for a level, or load all packages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("level", choices=LIBRARIES)
    parser.add_argument("--load", action="store_true", help="load what is installed")
    arguments = parser.parse_args()
    if arguments.load:
        failures = load_all(arguments.level)
        sys.exit("\n".join(failures) or 0)
    print(*missing_libraries(arguments.level))


def missing_libraries(level: str) -> list[str]:
    """Return what to install for the known libraries that this system lacks."""
    if sys.platform != "linux":
        return []
    missing = {name: package for name, package in LIBRARIES[level].items() if not is_there(name)}
    return list(missing.values() if shutil.which("apt-get") else missing)


def is_there(library: str) -> bool:
    """Return whether the dynamic linker finds a library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def load_all(level: str) -> list[str]:
    """Load the packages and start the programs of a level; return a line for each that fails."""
    failures = []
    for module in (*modules_of(requirements(level)), *own_modules()):
        try:
            importlib.import_module(module)
        except Exception as error:  # noqa: BLE001 - whatever a package raises is the answer
            if not is_of_extra(error):
                failures.append(f"{module}: {error}")
    programs = DEV_PROGRAMS if level != "run" and sys.platform == "linux" else ()
    return failures + [line for program in programs for line in start(program)]


def requirements(level: str) -> set[str]:
    """Return the names of the packages that pyproject.toml asks for, in lower case."""
    lines = pyproject()["project"]["dependencies"] + extras()["pdf"]
    if level != "run":
        groups = pyproject()["dependency-groups"]
        lines += [line for group in ("dev", "docs") for line in groups[group]]
    if level == "bench":
        lines += extras()["localize"]
    return names_of(lines)


def pyproject() -> dict[str, Any]:
    """Return pyproject.toml as a dictionary."""
    import tomllib  # noqa: PLC0415 - older Pythons, which lack it, may run this script without --load

    text = (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def extras() -> dict[str, list[str]]:
    """Return the requirements of each extra."""
    found: dict[str, list[str]] = pyproject()["project"]["optional-dependencies"]
    return found


def names_of(lines: Iterable[str]) -> set[str]:
    """Return the names of packages in requirements, in lower case."""
    return {re.split(r"[^\w.-]", line)[0].lower() for line in lines}


def is_of_extra(error: Exception) -> bool:
    """Return whether a module is missing that an extra installs, as of gis_radar or duckdb."""
    missing = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
    ours = chain.from_iterable(extras().values())
    theirs = chain.from_iterable(map(of_extras, requirements("dev")))
    return missing.partition(".")[0] in {
        name.replace("-", "_") for name in names_of(chain(ours, theirs))
    }


def of_extras(package: str) -> list[str]:
    """Return the requirements of all extras of an installed package."""
    try:
        lines = importlib.metadata.requires(package) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [line for line in lines if "extra ==" in line]


def modules_of(packages: set[str]) -> list[str]:
    """Return the public modules of installed packages."""
    owners = importlib.metadata.packages_distributions()
    return sorted(
        module
        for module, names in owners.items()
        if packages & {name.lower() for name in names} and re.fullmatch(r"[a-z]\w*", module)
    )


def own_modules() -> list[str]:
    """Return the modules of gis_radar."""
    root = Path(__file__).parents[1]
    paths = sorted((root / "gis_radar").rglob("[!_]*.py"))
    return [".".join(path.relative_to(root).with_suffix("").parts) for path in paths]


def start(program: str) -> list[str]:
    """Start a program of the environment with `--version`; return its message if it fails."""
    paths = [path for folder in sys.path if (path := Path(folder) / program).exists()]
    if not paths:
        return [f"{program}: not installed"]
    done = subprocess.run([paths[0], "--version"], capture_output=True, text=True, check=False)
    return [] if done.returncode == 0 else [f"{program}: {done.stderr.strip()}"]


if __name__ == "__main__":
    main()
