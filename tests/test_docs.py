"""The documentation: it builds without a warning, stands alone, and says what is so."""

import doctest
import importlib
import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import click
import matplotlib as mpl
import pandas as pd
import pytest
from click.testing import CliRunner
from doc_pages import DOCS, PAGES, ROOT, blocks, commands, sayings
from sites import START, crossing, pose, recording

import gis_radar as gr
from gis_radar.cli import group
from gis_radar.hdmap import TILE_COLUMNS as TILES
from gis_radar.poses.files import TRACK_FIELDS

LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src"}
HEAVY = {"localize", "track"}  # run elsewhere in the tests, and slow


class Page(HTMLParser):
    """What a built page holds: ids, links, and what a browser loads for it."""

    def __init__(self, text):
        super().__init__()
        self.ids, self.links, self.loads = set(), [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        self.ids |= {named[key] for key in ("id", "name") if named.get(key)}
        if tag == "a" and named.get("href"):
            self.links.append(named["href"])
        if tag == "link" and named.get("href"):
            self.loads.append(named["href"])
        if tag in LOADS and named.get(LOADS[tag]):
            self.loads.append(named[LOADS[tag]])


@pytest.fixture
def site(tmp_path):
    """The site: as `make test` has built it beside the demo, or built here."""
    built = os.environ.get("GIS_RADAR_DOCS")
    if built:
        return Path(built) / "html"
    command = [sys.executable, ROOT / "tools" / "build_docs.py", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return tmp_path / "html"


def test_the_site_builds_without_a_warning_and_stands_alone(site):
    pages = {
        path.relative_to(site).as_posix(): Page(path.read_text(encoding="utf-8"))
        for path in site.rglob("*.html")
    }
    expected = {p.relative_to(DOCS).with_suffix(".html").as_posix() for p in DOCS.rglob("*.md")}
    assert expected <= set(pages)
    assert broken_links(site, pages) == []
    assert [load for page in pages.values() for load in page.loads if is_outside(load)] == []
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet


def is_outside(address):
    return bool(urlsplit(address).netloc)


def broken_links(site, pages):
    """List the links that lead nowhere; of links to the outside only the form is looked at."""
    broken = []
    for name, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.netloc or parts.scheme:
                if parts.scheme not in {"http", "https", "mailto"} or " " in link:
                    broken.append((name, link))
                continue
            path = (site / name).parent / unquote(parts.path) if parts.path else site / name
            target = path.resolve()
            if not target.is_file():
                broken.append((name, link))
                continue
            key = target.relative_to(site.resolve()).as_posix()
            if parts.fragment and key in pages and unquote(parts.fragment) not in pages[key].ids:
                broken.append((name, link))
    return broken


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_the_commands_shown_exist_with_their_options(page):
    for words in commands(page):
        if words[1].startswith("-"):
            assert words[1] in {"--version", "--help"}
            continue
        assert words[1] in group.commands, words
        command = group.commands[words[1]]
        names = {name for param in command.params for name in param.opts} | {"--help"}
        used = {word.partition("=")[0] for word in words[2:] if re.match(r"--?[a-z]", word)}
        assert used <= names, (words, used - names)


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_links_within_the_repository_lead_somewhere(name):
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", (ROOT / name).read_text(encoding="utf-8"))
    inside = [link for link in links if not urlsplit(link).scheme]
    assert inside
    assert [link for link in inside if not (ROOT / link).exists()] == []


def test_the_tutorial_runs_as_it_stands(tmp_path, monkeypatch):
    sample = gr.sample_folder()
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    for words in commands(DOCS / "tutorial.md"):
        arguments = words[1:]
        if arguments[0] in HEAVY:
            assert parses(arguments)
            place = Path(arguments[arguments.index("-o") + 1])
            place.write_bytes((sample / "R1.json").read_bytes())
            continue
        done = CliRunner().invoke(group, arguments, catch_exceptions=False)
        assert done.exit_code == 0, done.output
        assert "warning:" not in done.output
        if arguments[0] == "sample":
            monkeypatch.chdir("sample")
            for path in Path().glob("R?.parquet"):  # its hundred seconds take longer, no more
                table = pd.read_parquet(path)
                table[table["time"] < table["time"].iloc[0] + 25.0].to_parquet(path, index=False)
    names = {}
    for code in blocks(DOCS / "tutorial.md", "python"):
        exec(compile(code, "tutorial.md", "exec"), names)  # noqa: S102 - our own example
    assert names["lanes"]["occupancy"].dropna().between(0.0, 1.0).all()
    assert (
        0.0 < names["sums"].loc["school", "occupied_s"] < names["sums"].loc["school", "visible_s"]
    )
    table = pd.read_csv("lanes.csv", sep=";", decimal=",", encoding="utf-8-sig", index_col="lane")
    assert table["length_m"].round(6).equals(names["lanes"]["length_m"].round(6))
    assert pd.read_csv("quality.csv")["verdict"].eq("good").all()


def parses(arguments):
    """Tell whether a command understands its arguments, without running it."""
    command = group.commands[arguments[0]]
    return isinstance(command.make_context(arguments[0], arguments[1:]), click.Context)


def with_examples():
    modules = {
        path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
        for path in (ROOT / "gis_radar").rglob("*.py")
        if ">>> " in path.read_text(encoding="utf-8")
    }
    return sorted(modules)


@pytest.mark.parametrize("name", with_examples())
def test_the_examples_of_docstrings_run(name, tmp_path, monkeypatch, measured_briefly):
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert result.attempted > 0
    assert result.failed == 0


def test_every_public_name_is_documented():
    shown = re.findall(r"auto\w+:: gis_radar\.(\w+)$", text_of("api.md"), flags=re.MULTILINE)
    assert sorted(shown) == sorted(gr.__all__)


def quoted():
    text = "".join(blocks(DOCS / "troubleshooting.md", "text"))
    return [line for line in text.splitlines() if line]


@pytest.mark.parametrize("line", quoted())
def test_the_messages_quoted_are_those_of_the_code(line):
    message = line.removeprefix("gis-radar: ")
    assert says(message), f"no text of gis_radar reads like: {message}"


def says(message):
    """Tell whether some text of the package reads so; a row, and a hint in brackets may follow."""
    cuts = [len(message), *(found.start() for found in re.finditer(r" \(", message))]
    ends = [re.sub(r" in row \d+$", "", message[:cut]) for cut in cuts]
    return any(pattern.fullmatch(end) for end in ends for pattern in sayings())


def text_of(name):
    return (DOCS / name).read_text(encoding="utf-8")


def test_every_measure_of_a_file_is_defined(tmp_path):
    defined = set(re.findall(r"`([\w.]+)`", text_of("definitions.md")))
    path = recording(tmp_path / "R1.parquet", [START], [[12.25, 0.0, -5.0]])
    dataset = gr.measure([path], [pose()], crossing(), None, tmp_path / "dataset", hits_only=True)
    row = {*gr.measure_quality(dataset).table}
    track = {name.removeprefix("sigma_").partition("_")[0] for name in TRACK_FIELDS}
    measures = {"occupied_s", "visible_s", "occupancy", "occupancy_se", "hit_s", "observed_s"}
    layers = measures | {"hit_share", "begin", "end"}
    assert (row | {*TILES} | track | layers) - defined == set()


def tool_named(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


def test_the_tables_of_a_dataset_are_those_of_the_schema():
    """After a change of the schema run python tools/dataset_page.py."""
    assert tool_named("dataset_page").tables() in text_of("dataset.md")


def test_the_accuracy_in_plain_words_is_what_the_benchmarks_measured():
    """After new figures run python tools/plain_accuracy.py, and look at README's last lines."""
    table = tool_named("plain_accuracy").plain_table(text_of("accuracy.md"))
    assert table in text_of("accuracy.md")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for least, most in re.findall(r"([\d.]+) to ([\d.]+) m off", table):
        assert f"{least}-{most} m" in readme
    for error in re.findall(r"mostly ([\d.]+) percentage points", table):
        assert re.search(rf"\b{re.escape(error)} (percentage points )?(in|on)\b", readme), error
