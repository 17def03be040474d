"""Messages of a run speak of keys of the site file: every option that the library names has one."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from gis_radar.base import InputError, Text, in_language, tr
from gis_radar.site.messages import KEYS, error_in_site_words, in_site_words
from tools.catalogue import PACKAGE, told, trees

KEYS_OF = PACKAGE / "site" / "messages.py"
# Of `gis-radar run` itself, and of commands that no run calls.
ASKING = {"--timeout", "--memory", "--relink", "--withdraw", "--schema"}  # of a dataset
TRAFFIC = {"--interval", "--counts", "--sections"}  # of gis-radar traffic
WITHOUT_MAP = {"--map", "--hits-only"}  # each site file has a map
OWN = {"--fresh", "--jobs", "--template", "--layer", "--version", "--stdin"}
CITY = {"--city-template", "--executor", "--nthreads"}  # of a city's run, and of its workers
LIVE = {"--webhook"}  # where the centre sends alerts, on its command line alone
OTHERS = CITY | ASKING | TRAFFIC | WITHOUT_MAP | OWN | LIVE


def options_named():
    """Return the options in texts of all rooms but the command line."""
    found = set()
    for path, nodes in trees(PACKAGE).items():
        if path.relative_to(PACKAGE).parts[0] in {"cli", "demo.py"} or path == KEYS_OF:
            continue
        docs = {
            id(node.body[0].value) for node in nodes
            if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef)
            and node.body and isinstance(node.body[0], ast.Expr)
        }  # fmt: skip
        for node in nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts = [] if id(node) in docs else re.findall(r"--[a-z][a-z-]+", node.value)
                found.update(texts)
    return found


def test_every_option_has_a_key_of_the_site_file():
    named = options_named()
    assert len(named) > 10
    assert sorted(named - set(KEYS) - OTHERS) == []


def test_options_with_a_key_are_values():
    """In a template the option would stay in a run's message; in a command to type it shall."""
    command = re.compile(r"gis-radar [a-z]+(?: --[a-z-]+)*")
    kept = {
        text for place, text in told() if not place.startswith("gis_radar/cli/")
        for option in re.findall(r"--[a-z][a-z-]+", command.sub("", text)) if option in KEYS
    }  # fmt: skip
    assert kept == {"--cycle {}={}ms"}


@pytest.mark.parametrize(
    ("told", "shown", "german"),
    [(Text("a frame is not observed by it; {}", Text("--cycle {}={}ms", "R1", 57)),
      'a frame is not observed by it; cycle = "57ms" in [[sensor]] R1', None),
     (Text("state it: {} EPSG:25832", "--scan-crs"), "state it: crs in [scan] EPSG:25832",
      "es angeben: crs in [scan] EPSG:25832"),
     (Text("set {}", Text("the view's max_range_m or {}", "--max-range")),
      "set max_range_m in [sensor.view]", None),
     # a command to type keeps its options
     ("try: gis-radar track --pose POSE", "try: gis-radar track --pose POSE", None),
     (Text("no frame from {} on", "2025-06-12T07:30Z"),
      "no frame from 2025-06-12 09:30 UTC+02:00 on", None),
     (Text("{}: {}", "R1", Text("fits")), "R1: fits", "R1: passt"),
     (Text("{}; or go on anyway: {}", Text("leave that time out"), Text("{} {}", "--accept", "R1")),
      "leave that time out; or go on anyway: accept = true in [[sensor]] R1",
      "diese Zeit weglassen; oder trotzdem weiter: accept = true in [[sensor]] R1")],
)  # fmt: skip
def test_messages_are_in_the_words_of_the_site_file(told, shown, german):
    said = in_site_words(told, "Europe/Berlin")
    assert said == shown
    with in_language("de"):
        assert german is None or tr(said) == german


@pytest.mark.parametrize(
    ("told", "shown"),
    [("/data/a.osm: x", "a.osm: x"), ("no file matches '/data/b*'", "no file matches 'b*'"),
     ("/mnt/data/maps/a.osm: x", "/mnt/data/maps/a.osm: x"),
     ("a.osm,/data/b.osm (/data/c)", "a.osm,b.osm (c)"), ("~/data/a.osm", "~/data/a.osm")],
)  # fmt: skip
def test_a_folder_is_cut_at_the_start_of_a_path_only(told, shown):
    assert in_site_words(told, "UTC", Path("/data")) == shown


def test_errors_name_files_from_the_folder_of_the_site_on():
    place = Path("/data/R1.parquet")
    told = InputError("{}: is damaged", place, hint=Text("look at {}", place))
    error = error_in_site_words(told, "UTC", Path("/data"))
    assert (error.message, error.hint) == ("R1.parquet: is damaged", "look at R1.parquet")
    assert "/data" not in str(error)
