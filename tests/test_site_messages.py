"""Messages of a run speak of keys of the site file: every option that the library names has one."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import gis_radar as gr
from gis_radar.errors import InputError
from gis_radar.languages import messages
from gis_radar.languages.site_keys import KEYS, keys_for_options
from gis_radar.site.messages import error_in_site_words, in_site_words
from gis_radar.site.settings import site_template
from gis_radar.words import speaking, tr_message

HOLE = re.compile(r"\{\w*\}")
PACKAGE = Path(gr.__file__).parent
# Of `gis-radar run` itself, and of commands that no run calls.
IMAGE = {"--build-arg", "--no-install-recommends", "--no-cache-dir"}  # of a Dockerfile
ASKING = {"--timeout", "--memory", "--relink", "--withdraw"}  # of gis-radar query and dataset
OTHERS = IMAGE | ASKING | {"--fresh", "--jobs", "--template", "--layer", "--version", "--stdin"}


def options_named():
    """Return the options in texts of all rooms but the command line."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).parts[0] in {"cli", "demo.py"} or path.name == "site_keys.py":
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        doc = {id(node.body[0].value) for node in ast.walk(tree)
               if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef)
               and node.body and isinstance(node.body[0], ast.Expr)}  # fmt: skip
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found |= (
                    set() if id(node) in doc else set(re.findall(r"--[a-z][a-z-]+", node.value))
                )
    return found


def test_every_option_has_a_key_of_the_site_file():
    assert len(options_named()) > 10
    assert sorted(options_named() - set(KEYS) - OTHERS) == []


def test_every_key_is_one():
    keys = set(re.findall(r"^#? ?(\w+) = ", site_template(), flags=re.MULTILINE))
    assert {text.split(" in ")[0] for text in KEYS.values()} <= keys


def test_messages_are_in_the_words_of_the_site_file():
    told = "a frame is not observed by it; --cycle R1=57ms lets a frame cover its whole cycle"
    text = 'a frame is not observed by it; cycle = "57ms" in [[sensor]] R1 lets a frame cover its'
    assert in_site_words(told, "UTC").startswith(text)
    assert in_site_words("state it: --scan-crs EPSG:25832", "UTC") == (
        "state it: crs in [scan] EPSG:25832"
    )


def test_a_command_to_type_keeps_its_options():
    text = "is the pose off? gis-radar sight --recording lists the tiles; use --scan"
    assert in_site_words(text, "UTC") == (
        "is the pose off? gis-radar sight --recording lists the tiles; use files in [scan]"
    )


def test_messages_in_the_words_of_the_site_file_have_their_german():
    said = {text: keys_for_options(HOLE.sub("7", text)) for text in messages("de")}
    other = {text: words for text, words in said.items() if words != HOLE.sub("7", text)}
    assert len(other) > 10
    with speaking("de"):
        assert [words for words in other.values() if tr_message(words) == words] == []
        cycle = in_site_words(
            "R1 delivers every 57 ms, and a frame is valid for 100 ms: 3 % of the 50 ms steps read "
            "as not observed by it; --cycle R1=57ms makes a frame valid for its whole cycle",
            "UTC",
        )  # fmt: skip
        assert 'cycle = "57ms" in [[sensor]] R1' in tr_message(cycle)


def test_remarks_name_files_from_the_folder_of_the_site_on(tmp_path):
    """A report goes out: where its site lay on somebody's computer is nobody's business."""
    told = f"{tmp_path}/streets.gpkg: 2 streets are called Ring; their lanes differ by number"
    shown = "streets.gpkg: 2 streets are called Ring; their lanes differ by number"
    assert in_site_words(told, "UTC", tmp_path) == shown
    assert in_site_words("/else/streets.gpkg: x", "UTC", tmp_path) == "/else/streets.gpkg: x"


@pytest.mark.parametrize(
    ("told", "shown"),
    [("/data/a.osm: x", "a.osm: x"), ("no file matches '/data/b*'", "no file matches 'b*'"),
     ("/mnt/data/maps/a.osm: x", "/mnt/data/maps/a.osm: x"),
     ("a.osm,/data/b.osm (/data/c)", "a.osm,b.osm (c)"), ("~/data/a.osm", "~/data/a.osm")],
)  # fmt: skip
def test_a_folder_is_cut_at_the_start_of_a_path_only(told, shown):
    assert in_site_words(told, "UTC", Path("/data")) == shown


def test_errors_name_files_from_the_folder_of_the_site_on():
    told = InputError("/data/R1.parquet: is damaged", hint="look at /data/R1.parquet")
    error = error_in_site_words(told, "UTC", Path("/data"))
    assert (error.message, error.hint) == ("R1.parquet: is damaged", "look at R1.parquet")
    assert "/data" not in str(error)
