"""The site file: what it may hold, and how its errors read."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

import gis_radar as gr
from gis_radar.base import InputError
from gis_radar.live import edge_template, read_edge_file
from gis_radar.site import Name, Site, site_template
from gis_radar.site.values import lines_of, table_of
from tools import toml_pages

ROOT = Path(__file__).parents[1]
FILES = ("junction.osm", "scan_1.laz", "scan_2.laz", "R1_1.parquet", "R1_2.parquet", "R2.parquet",
         "R2.json")  # fmt: skip
WHOLE = """\
title = "Junction"
timezone = "Europe/Berlin"
attribution = ["A", "B"]
[map]
file = "junction.osm"
origin = [690000, 5336000]
[scan]
files = ["scan_*.laz"]
[tiles]
length = 1
[measure]
clearance = [-0.5, 4.5]
[heatmap]
intervals = ["15min", "1H"]
[[sensor]]
name = "R1"
recordings = ["R1_2.parquet", "R1_*.parquet"]
guess = [690356, 5336183, 520]
compass = "north-east"
view = { max_range_m = 200 }

[[sensor]]
name = "R2"
recordings = "R2.parquet"
pose = "R2.json"
[sensor.view]
azimuth_deg = 90
"""


@pytest.fixture
def read(tmp_path):
    """Read a text as a site file beside the files of a site."""
    for name in FILES:
        (tmp_path / name).touch()

    def call(text):
        (tmp_path / "SITE.toml").write_text(text, encoding="utf-8")
        return gr.read_site(tmp_path / "SITE.toml")

    return call


@pytest.fixture
def refuse(read):
    def call(text, *parts):
        with pytest.raises(InputError) as caught:
            read(text)
        said = f"{caught.value.message} | {caught.value.hint}"
        assert "\n" not in said
        assert "SITE.toml" in said
        for part in parts:
            assert part in said

    return call


def test_a_whole_site(read, tmp_path):
    site = read(WHOLE)
    assert site.title == "Junction"
    assert site.map.origin == (690000.0, 5336000.0)
    assert [path.name for path in site.scan.files] == ["scan_1.laz", "scan_2.laz"]
    assert site.tiles.length == 1.0
    assert site.heatmap.intervals == ("15min", "1h")
    first, second = site.sensor
    assert [path.name for path in first.recordings] == ["R1_2.parquet", "R1_1.parquet"]
    assert (first.guess, first.compass, first.method) == (
        (690356.0, 5336183.0, 520.0),
        45.0,
        "lane",
    )
    assert (first.view.max_range_m, first.view.azimuth_deg) == (200.0, 120.0)
    assert (second.pose, second.view.azimuth_deg) == (tmp_path / "R2.json", 90.0)
    assert set(site.inputs) == {tmp_path / name for name in FILES}


def test_the_least_that_will_do(read):
    site = read('title="J"\n[map]\nfile="junction.osm"\n[[sensor]]\nname="R"\n'
                'recordings="R1_1.parquet"\npose="R2.json"')  # fmt: skip
    assert site.scan is None
    assert site.heatmap.intervals == ()
    assert site.timezone == "UTC"


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("guess =", "gues =", (":18: sensor[0].gues: is no key", "did you mean guess?")),
        ("max_range_m", "max_range", (":20: sensor[0].view.max_range:", "mean max_range_m?")),
        ("azimuth_deg = 90", "azimut = 90", (":27: sensor[1].view.azimut:", "mean azimuth_deg?")),
        ("title", "xyzzy", (":1: xyzzy: is no key", "known are title, timezone")),
        ('title = "Junction"\n', "", ("lacks title", "e.g. title = ")),
        ('file = "junction.osm"', "", (":4: map: lacks file", 'e.g. file = "junction.osm"')),
        ("junction.osm", "junktion.osm", (":5: map.file:", "junktion.osm: no such file")),
        ("scan_*", "scam_*", (":8: scan.files: no file matches", "scam_*.laz")),
        ('name = "R2"', 'name = "r1"', (":23: sensor[1].name: two sensors", "'R1' and 'r1'")),
        ('pose = "R2.json"', "", (":22: sensor[1]: has neither guess nor pose",)),
        ('compass = "north-east"', 'pose = "R2.json"', ("sensor[0]: has both guess and pose",)),
        ('"north-east"', '"up"', (":19: sensor[0].compass: is 'up'", "north-east")),
        ("compass", "heading = 3\ncompass", ("has both heading and compass",)),
        ('pose = "R2.json"', 'pose = "R2.json"\nheading = 3', ("has both pose and heading",)),
        ("azimuth_deg = 90", "min_range_m = 400", (":26: sensor[1].view:", "expected ascending")),
        ("Europe/Berlin", "Europe/Ingolstadt", (":2: timezone:", "IANA", "Europe/Berlin")),
        ("Europe/Berlin", "../../etc/passwd", (":2: timezone:", "IANA")),
        ("[690356, 5336183, 520]", "[11.42, 48.76]", (":18: sensor[0].guess:", "degrees", "east")),
        ("[690356, 5336183, 520]", "[48.76, 11.42]", (":18: sensor[0].guess:", "not degrees")),
        ("[690356, 5336183, 520]", "[1, 2, 3, 4]", ("guess: is [1, 2, 3, 4]", "[E, N]")),
        ("[690356, 5336183, 520]", "[nan, 5e6]", (":18: sensor[0].guess:", "[E, N]")),
        ("[690356, 5336183, 520]", "[true, 5e6]", (":18: sensor[0].guess:", "[E, N]")),
        ("length = 1", 'length = "1"', (":10: tiles.length: is '1'", "0.05 to 100")),
        ("length = 1", "length = 0", ("tiles.length: is 0", "0.05 to 100")),
        ("[-0.5, 4.5]", "[4.5, -0.5]", (":12: measure.clearance:", "ascending")),
        ('"1H"', '"soon"', (":14: heatmap.intervals:", "'soon'", "no duration")),
        ('"1H"', '"60min"', None),
        ('"1H"', '"900s"', ("intervals", "differ")),
        ('["A", "B"]', '["A", 2]', (":3: attribution: is ['A', 2], expected a list of texts",)),
        ("[map]", '[map]\ncrs = "EPSG:4326"', (":5: map.crs:", "geographic")),
        ("[scan]", '[scan]\nengine = "qgis"', ("scan.engine: is 'qgis'", "auto, pdal, laspy")),
        ("[scan]", '[scan]\nroad = "R2.json"', (":7: scan: both files and road",)),
        ('files = ["scan_*.laz"]', "", (":7: scan: neither files nor road",)),
        ('[scan]\nfiles = ["scan_*.laz"]\n', "", ("pose of R1 is to be found", "[scan]")),
        ('name = "R1"', 'name = "../R1"', ("sensor[0].name: is '../R1'", "folder")),
        ('name = "R1"', "name = 1", (":16: sensor[0].name: is 1",)),
        ("[[sensor]]", "[sensor]", ("not TOML",)),
        ("[map]", "[map", ("not TOML", "--template")),
    ],
)  # fmt: skip
def test_an_error_names_line_and_key(read, refuse, old, new, parts):
    assert old in WHOLE
    text = WHOLE.replace(old, new, 1)
    if parts is None:
        read(text)
    else:
        refuse(text, *parts)


def test_a_site_file_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        gr.read_site(tmp_path / "SITE.toml")
    (tmp_path / "SITE.toml").write_bytes(b"title = '\xff'")
    with pytest.raises(InputError, match="not UTF-8"):
        gr.read_site(tmp_path / "SITE.toml")


def keys(table, path=()):
    """All keys of the models, those of tables below them too."""
    for name, field in table.model_fields.items():
        yield (*path, name)
        if (below := table_of(field)) is not None:
            yield from keys(below, (*path, name))


def found(raw, path=()):
    for name, value in raw.items():
        yield (*path, name)
        below = value[0] if isinstance(value, list) and isinstance(value[0], dict) else value
        if isinstance(below, dict):
            yield from found(below, (*path, name))


def test_the_template_holds_every_key_and_its_values_fit(read, tmp_path):
    template = site_template()
    assert {("map", "file"), ("sensor", "guess")} <= set(found(tomllib.loads(template)))
    # Without the # before keys and tables, all that a site file may say.
    whole = re.sub(r"^# (?=\[|[a-z_]+ = )", "", template, flags=re.MULTILINE)
    said = {path for path in found(tomllib.loads(whole)) if "columns" not in path[:-1]}
    assert said == set(keys(Site))
    for name in (
        "junction.osm",
        "streets.gpkg",
        "scan_a.laz",
        "road.laz",
        "R1_0.parquet",
        "R2.json",
        "clocks.json",
        "tiles.gpkg",
        "R1.password",
        "ca.crt",
        "page.token",
        "sensorthings.password",
        "sensorthings.token",
    ):
        (tmp_path / name).touch()
    assert read(template).sensor[0].name == "R1"
    one_of_each = re.sub(r"^(road|compass|pose) = ", "# \\1 = ", whole, flags=re.MULTILINE)
    assert read(one_of_each).sensor[0].view.max_range_m == 300.0


def test_the_documents_are_those_of_the_models():
    """After a change of the models run python tools/toml_pages.py."""
    for page, root in toml_pages.PAGES.items():
        document = page.read_text(encoding="utf-8")
        assert "default True" not in document  # TOML writes true
        assert document.endswith(toml_pages.reference(root))


def test_the_template_of_a_sensor_needs_its_uncommented_lines_only(tmp_path):
    path = tmp_path / "R1.toml"
    path.write_text(edge_template())
    for name in ("tiles.gpkg", "R1.json"):
        (tmp_path / name).touch()
    read = read_edge_file(path)
    assert read.map is None
    assert read.source.address == "udp://224.0.2.2:42102"


def test_the_examples_of_the_document_and_the_sample_can_be_read(read, tmp_path):
    document = (ROOT / "docs" / "site-file.md").read_text(encoding="utf-8")
    for name in ("scan.laz", "R2.parquet"):
        (tmp_path / name).touch()
    (example,) = re.findall(r"```toml\n(.*?)```", document, flags=re.DOTALL)
    assert [sensor.name for sensor in read(example).sensor] == ["R1", "R2"]
    sample = gr.read_site(gr.sample_folder() / "SITE.toml")
    assert str(sample) == repr(sample) == "Site(Sample junction (simulated): R1, R2)"
    for sensor in sample.sensor:
        assert sensor.heading is sensor.compass is sensor.pose is None
        true = gr.read_pose(gr.sample_folder() / f"{sensor.name}.json")
        off_m = (
            (sensor.guess[0] - true.easting) ** 2 + (sensor.guess[1] - true.northing) ** 2
        ) ** 0.5
        assert 3.0 < off_m < 10.0


NAMES = st.text("abc", min_size=1, max_size=3)


@given(st.lists(st.tuples(NAMES, st.lists(NAMES, unique=True)), max_size=4), st.booleans())
def test_lines_are_those_of_the_keys(tables, spaced):
    lines, expected, counts = [], {}, {}
    for name, names in tables:
        counts[name] = counts.get(name, -1) + 1
        lines.append(f"[[{name}]]" if not spaced else f"  [[ {name} ]] # {name} = 1")
        expected[name, counts[name]] = len(lines)
        for each in names:
            lines.append(f"{each} = 1 # [{each}]")
            expected[name, counts[name], each] = len(lines)
    assert lines_of("\n".join(lines)) == expected
    tomllib.loads("\n".join(lines))


@pytest.mark.parametrize("name", ["R+", "R#1", 101 * "\u00fc"])
def test_wildcards_of_mqtt_and_long_words_are_no_names(name):
    with pytest.raises(ValueError, match="a name that a folder can have"):
        TypeAdapter(Name).validate_python(name)
