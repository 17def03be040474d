"""What the set-up does about PDAL, with apt and PDAL replaced by stand-ins."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "tools" / "get_pdal.sh"
CONDA_NAMES = {
    "duckdb": ["python-duckdb"],
    "laspy": ["laspy", "lazrs-python"],
    "matplotlib": ["matplotlib-base"],
    "tzdata": ["python-tzdata"],
}


def is_debian_12():
    try:
        text = Path("/etc/os-release").read_text(encoding="utf-8")
    except OSError:
        return False
    fields = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    return (fields.get("ID"), fields.get("VERSION_ID")) == ("debian", '"12"')


needs_sh = pytest.mark.skipif(os.name == "nt", reason="the set-up is a shell script")
on_debian = pytest.mark.skipif(
    not is_debian_12() or shutil.which("apt-get") is None,
    reason="only on Debian 12 does the set-up fetch PDAL",
)


def write_program(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Give a folder with the script alone, and programs that stand before the system's."""
    folder = tmp_path / "check out"
    (folder / "tools").mkdir(parents=True)
    shutil.copy(SCRIPT, folder / "tools")
    (tmp_path / "programs").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "programs"), prepend=os.pathsep)
    monkeypatch.delenv("GIS_RADAR_PDAL", raising=False)
    return folder


def run(checkout):
    command = ["/bin/sh", checkout / "tools" / "get_pdal.sh"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, (done.stdout + done.stderr).splitlines()


def replace_apt(checkout, text):
    """Let apt note that it was asked for lists, and do what `text` says; it has one mirror."""
    note = f"""
        [ "$1" = --print-uris ] && [ -z "${{APT_CONFIG:-}}" ] &&
            echo "'http://a.example/dists/bookworm/main/binary-amd64/Packages.xz'" && exit
        case " $* " in *" update "*) echo x >>"{checkout.parent}/calls";; esac"""
    write_program(checkout.parent / "programs" / "apt-get", f"{note}\n{text}")


def calls(checkout):
    file = checkout.parent / "calls"
    return len(file.read_text().split()) if file.exists() else 0


@needs_sh
def test_what_is_there_is_not_fetched_again(checkout):
    replace_apt(checkout, "exit 1")
    write_program(checkout / ".pdal" / "bin" / "pdal", "echo pdal 2.2.0")
    assert run(checkout) == (0, [])
    assert calls(checkout) == 0


@needs_sh
def test_the_users_own_pdal_is_enough(checkout, monkeypatch):
    replace_apt(checkout, "exit 1")
    write_program(checkout.parent / "programs" / "pdal", "echo pdal 2.9.0")
    assert run(checkout) == (0, [])
    (checkout.parent / "programs" / "pdal").unlink()
    monkeypatch.setenv("GIS_RADAR_PDAL", "/somewhere/pdal")
    assert run(checkout) == (0, [])
    assert not (checkout / ".pdal").exists()
    assert calls(checkout) == 0


@on_debian
def test_an_unreachable_suite_goes_on_in_one_line(checkout):
    replace_apt(checkout, "echo 'W: Failed to fetch this' >&2; exit 100")
    assert run(checkout) == (0, ["set-up: no PDAL for the tests: Failed to fetch this"])
    assert run(checkout)[0] == 0
    assert calls(checkout) == 2
    assert sorted(path.name for path in checkout.iterdir()) == ["tools"]


def replace_packages(checkout, loader):
    """Let apt deliver one package, which holds a program and a loader that is a script."""
    replace_apt(checkout, 'for each; do case $each in Dir::Cache=*) cache=${each#*=};; esac; done\n'
                          'touch "$cache/archives/one.deb"')  # fmt: skip
    tree = f"""
        cd "$3" && mkdir -p etc lib/here usr/bin usr/share/doc usr/share/proj usr/share/gdal
        printf '%s\\n' '#!/bin/sh' '{loader}' >lib/here/ld-9.99.so
        chmod 755 lib/here/ld-9.99.so"""
    write_program(checkout.parent / "programs" / "dpkg", tree)


@on_debian
def test_packages_become_a_folder_that_can_be_moved(checkout, tmp_path):
    replace_packages(checkout, 'echo pdal 2.2.0 "$@" "$PROJ_LIB"')
    code, [line] = run(checkout)
    assert (code, line[:30]) == (0, "set-up: fetching PDAL into .pd")
    assert run(checkout) == (0, [])
    assert sorted(path.name for path in checkout.iterdir()) == [".pdal", "tools"]
    moved = (checkout / ".pdal").rename(tmp_path / "else where")
    assert sorted(path.name for path in moved.iterdir()) == ["bin", "lib", "usr"]
    assert sorted(path.name for path in (moved / "usr" / "share").iterdir()) == ["gdal", "proj"]
    command = [moved / "bin" / "pdal", "pipeline"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said.split(" --library-path ")[0] == "pdal 2.2.0"
    assert said.endswith(f"{moved}/usr/bin/pdal pipeline {moved}/usr/share/proj\n")
    assert "check out" not in said


@on_debian
def test_a_pdal_that_does_not_start_leaves_none(checkout):
    replace_packages(checkout, "exit 1")
    code, lines = run(checkout)
    assert code == 0
    assert lines[-1].endswith("Debian 11's PDAL does not start here")
    assert sorted(path.name for path in checkout.iterdir()) == ["tools"]


SOURCES = """
deb [trusted=yes] http://a.example/debian bookworm main contrib
deb http://b.example/debian/ bookworm non-free
deb http://c.example/debian bookworm-updates main
deb-src http://d.example/debian bookworm main
deb https://e.example/mirror bookworm main
"""


@on_debian
def test_the_machines_own_mirrors_are_asked_and_none_is_trusted_without_keys(checkout, monkeypatch):
    apt = checkout.parent / "apt"
    apt.mkdir()
    (apt / "sources.list").write_text(SOURCES)
    settings = (
        f'Dir::Etc::sourcelist "{apt}/sources.list"; Dir::Etc::sourceparts "/dev/null";\n'
        'APT::Get::AllowUnauthenticated "true"; Acquire::AllowInsecureRepositories "true";\n'
    )
    (apt / "apt.conf").write_text(settings)
    real = shutil.which("apt-get")
    replace_apt(checkout, f"""
        [ "$1" = --print-uris ] && exec {real} "$@"
        for each; do case $each in Dir::Etc::sourcelist=*) list=${{each#*=}};; esac; done
        cat "$list" >"{apt}/entries"
        echo "$@" >"{apt}/words"
        exit 100""")  # fmt: skip
    monkeypatch.setenv("APT_CONFIG", str(apt / "apt.conf"))
    assert run(checkout)[0] == 0
    entries = (apt / "entries").read_text().splitlines()
    assert entries == [f"deb {place} bullseye main" for place in
                       ("http://a.example/debian", "https://e.example/mirror")]  # fmt: skip
    words = (apt / "words").read_text()
    assert "Acquire::AllowInsecureRepositories=false" in words
    assert "APT::Get::AllowUnauthenticated=false" in words


@on_debian
def test_a_machine_without_sources_goes_on_in_one_line(checkout, monkeypatch):
    settings = checkout.parent / "apt.conf"
    settings.write_text('Dir::Etc::sourcelist "/dev/null"; Dir::Etc::sourceparts "/dev/null";')
    monkeypatch.setenv("APT_CONFIG", str(settings))
    code, [line] = run(checkout)
    assert code == 0
    assert "apt knows no source" in line


WITHOUT_EXTRAS = """
import importlib.abc, sys
sys.path.insert(0, "tools")
import missing_libraries as tool

class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {
            "movingpandas", "open3d", "paho", "prometheus_client", "starlette", "uvicorn"
        }:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
tool.modules_of = lambda _: []
for known in ("gis_radar.live.server", "gis_radar.cli", "gis_radar.demo"):
    tool.own_modules = lambda: [known]
    print(known, tool.load_all("run"), "uvicorn" in sys.modules)
tool.own_modules = lambda: ["gis_radar.nowhere"]
print(tool.load_all("run"))
"""


def test_what_extras_bring_is_not_needed_for_the_demo():
    """A bare machine has no web server: `make demo` sets up what gis-radar asks for, no more."""
    command = [sys.executable, "-c", WITHOUT_EXTRAS]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.stdout.splitlines() == [
        "gis_radar.live.server [] False",
        "gis_radar.cli [] False",
        "gis_radar.demo [] False",
        "[\"gis_radar.nowhere: No module named 'gis_radar.nowhere'\"]",
    ], done.stderr


def test_conda_gets_what_pyproject_asks_for():
    text = (ROOT / "environment.yml").read_text(encoding="utf-8")
    entries = re.findall(r"(?m)^  - ([\w-]+)((?:>=[\d.]+)?)$", text)
    given = {name: floor for name, floor in entries if name not in {"conda-forge", "pip"}}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {"python": project["requires-python"], "pdal": ">=2.2"}
    for requirement in map(
        Requirement, project["dependencies"] + project["optional-dependencies"]["pdf"]
    ):
        first, *more = CONDA_NAMES.get(requirement.name, [requirement.name])
        wanted |= {first: str(requirement.specifier)} | dict.fromkeys(more, "")
    assert given == wanted


@needs_sh
def test_an_environment_of_another_checkout_is_not_emptied(checkout):
    """A link in the place of ours is taken away, not what it leads to."""
    shutil.copy(ROOT / "tools" / "set_up.sh", checkout / "tools")
    other = checkout.parent / "other"
    write_program(other / "bin" / "python", "exit 0")
    (checkout / ".venv").symlink_to(other)
    python = checkout.parent / "programs" / "python"
    write_program(python, 'case "$*" in *"-m venv"*) rm -rf .venv/*; exit 1;; esac')
    done = subprocess.run(
        ["/bin/sh", checkout / "tools" / "set_up.sh", "run"], capture_output=True, text=True,
        env=os.environ | {"PYTHON": str(python)}, check=False,
    )  # fmt: skip
    assert "could not make .venv" in done.stderr
    assert (other / "bin" / "python").exists()
