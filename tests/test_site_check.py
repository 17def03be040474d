"""The check of a site before its run: what fits together, what is odd, what is refused."""

import json
import math
import os
import re
import shutil
from pathlib import Path
from xml.etree.ElementTree import parse

import geopandas as gpd
import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import shapely
from click.testing import CliRunner

import gis_radar as gr
from gis_radar.cli import group
from gis_radar.cli.console import JsonConsole, TerminalConsole

SAMPLE = Path(__file__).parents[1] / "sample_maps"


@pytest.fixture
def place(tmp_path):
    """Give a function that writes a site file beside the sample's files, with a text changed."""

    def make(*changes):
        text = (SAMPLE / "SITE.toml").read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        for path in SAMPLE.iterdir():
            if path.suffix in {".osm", ".laz", ".parquet", ".json"}:
                (tmp_path / path.name).symlink_to(path)
        site = tmp_path / "SITE.toml"
        site.write_text(text, encoding="utf-8")
        return site

    return make


@pytest.fixture
def unjudged(monkeypatch):
    """Let recordings pass where a test looks at other things: most of the time of a check."""
    monkeypatch.setattr("gis_radar.site.check.check_recordings", lambda *_, **__: ())


def test_what_a_check_finds(place):
    """No warning either: the time zone is that of the place, Europe/Berlin."""
    found = gr.check_site(place())
    assert (found.crs, found.lanelets, found.warnings) == ("EPSG:25832", 48, ())
    table = pq.read_table(SAMPLE / "R1.parquet", columns=["time", "x", "y", "z"])
    time, x, y, z = (table[name].to_numpy().astype(float) for name in table.column_names)
    seen = np.isfinite(x)
    one = found.sensors["R1"]
    assert (one.begin, one.end, one.detections) == (time[0], time[-1], int(seen.sum()))
    # numpy's percentile as the oracle: the histogram has bins of a degree and a metre
    azimuth = np.percentile(np.degrees(np.abs(np.arctan2(y[seen], x[seen]))), 99.9)
    reach = np.percentile(np.sqrt(x * x + y * y + z * z)[seen], 99.9)
    assert one.view["azimuth_deg"] == 2 * math.ceil(azimuth)
    assert one.view["max_range_m"] == pytest.approx(reach, abs=1.0)
    assert 0 < one.view["elevation_deg"] < 60


def test_the_command(place):
    done = CliRunner().invoke(group, ["check", str(place()), "--json"])
    assert done.exit_code == 0
    *events, result = [json.loads(line) for line in done.stdout.splitlines()]
    bars = [(each["stage"], each["total"]) for each in events if each["event"] == "progress"]
    assert list(dict.fromkeys(bars)) == [  # nothing reads long without one, none is of nothing
        ("reading lanelets", 48), ("reading recordings", 2), ("checking poses and recordings", 2),
    ]  # fmt: skip
    assert result["summary"]["sensors"]["R2"]["begin"] == "2025-06-12T07:30:00Z"
    assert result["outputs"] == []


@pytest.mark.usefixtures("unjudged")
def test_warnings_of_the_map_are_counted_too(place, monkeypatch):
    line = "junction.osm: 12 lanelets repaired, see layer problems of the tiles"

    def read_with_a_warning(path, *, reporter, **options):
        reporter.warn(line)
        return gr.read_map(path, **options)

    monkeypatch.setattr("gis_radar.site.check.read_map", read_with_a_warning)
    assert gr.check_site(place()).warnings == (line,)


@pytest.mark.usefixtures("unjudged")
def test_a_site_that_can_be_run_is_told_so(place):
    done = CliRunner().invoke(group, ["check", str(site := place())])
    says, _, command = done.stdout.splitlines()[-1].partition(": gis-radar ")
    assert (says, command) == ("the site can be run", f"run {site} -o results")
    context = group.commands["run"].make_context("run", command.split()[1:])
    assert context.params["site"] == site


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("690356.0, 5336183.0", "691356.0, 5336183.0"), r"R1 stands \d{3} m from the nearest"),
        (("690356.0, 5336183.0", "5336183.0, 690356.0"), r"R1 stands [\d,]+ m from the nearest"),
        (('crs = "EPSG:25832"', 'crs = "EPSG:4326"'), "geographic"),
        (('"R1.parquet"', '"R9.parquet"'), "no such file"),
        (('"R1.parquet"', '"other.json"'), r"/other.json: of no known radar format"),
        (('"R2.parquet"', '"R1.parquet"'), "R1.parquet is a recording of R1, too"),
        (("guess = [690383.0, 5336229.0]", 'pose = "other.json"'), r"in EPSG:25833, the map"),
    ],
)
def test_what_is_refused(place, tmp_path, change, words):
    pose = json.loads((SAMPLE / "R2.json").read_text()) | {"crs": "EPSG:25833"}
    (tmp_path / "other.json").write_text(json.dumps(pose))
    with pytest.raises(gr.InputError, match=words) as caught:
        gr.check_site(place(change))
    assert "\n" not in str(caught.value)


ROAD = 'road = "scan.laz"'


@pytest.mark.parametrize("key", ["files", "road"])
def test_a_scan_of_another_place_is_refused(place, tmp_path, key):
    site = place(('files = ["scan.laz"]', 'files = ["scan.laz"]' if key == "files" else ROAD))
    import laspy

    scan = laspy.read(SAMPLE / "scan.laz")
    scan.x = scan.x + 5000.0
    (tmp_path / "scan.laz").unlink()
    scan.write(tmp_path / "scan.laz")
    with pytest.raises(gr.InputError, match=r"scan.laz: not where the map junction.osm is"):
        gr.check_site(site)


@pytest.mark.usefixtures("unjudged")
def test_a_map_without_successors_and_streets_without_names_are_told(place, tmp_path):
    """Before the run: it is the map that is to be mended."""
    line = shapely.LineString([(690300, 5336150), (690500, 5336220)])
    gpd.GeoDataFrame({"id": [7]}, geometry=[line], crs="EPSG:25832").to_file(
        tmp_path / "streets.gpkg"
    )
    apart = parse(SAMPLE / "junction.osm")  # noqa: S314 - our own file
    for each in apart.getroot().findall("relation"):
        if each.get("id") not in {"553", "267", "705"}:  # none of these leads to another
            apart.getroot().remove(each)
    apart.write(tmp_path / "apart.osm")
    site = place(('file = "junction.osm"', 'file = "apart.osm"\nstreets = "streets.gpkg"'))
    first, second = gr.check_site(site).warnings
    assert first.startswith("no lanelet of the map follows another: each is a lane of its own")
    assert second.startswith("streets.gpkg: no column of names (name, street, ")


@pytest.mark.usefixtures("unjudged")
def test_recordings_that_overlap_are_named(place, tmp_path):
    site = place(('"R1.parquet"', '"part_*.parquet"'))
    table = pq.read_table(SAMPLE / "R1.parquet")
    begin = table["time"][0].as_py()
    pq.write_table(table.filter(pc.less(table["time"], begin + 70)), tmp_path / "part_a.parquet")
    pq.write_table(table.filter(pc.greater(table["time"], begin + 50)), tmp_path / "part_b.parquet")
    found = gr.check_site(site)
    assert (
        found.warnings
        == (
            "R1: part_a.parquet and part_b.parquet overlap in time: what both hold counts once",
            "R1: 70 s in one recording rarely suffice to find its pose, 100 s are a good length",
        )[: len(found.warnings)]
    )
    assert found.warnings


@pytest.mark.parametrize(
    ("zone", "odd"),
    [("Europe/Lisbon", False), ("America/New_York", True), ("Asia/Tokyo", True),
     ("Pacific/Kiritimati", True)],
)  # fmt: skip
@pytest.mark.usefixtures("unjudged")
def test_a_time_zone_of_another_place_is_named(place, zone, odd):
    found = gr.check_site(place(("Europe/Berlin", zone)))
    assert bool(found.warnings) is odd
    if odd:
        assert f"timezone {zone} is" in found.warnings[0]


@pytest.mark.usefixtures("unjudged")
def test_sensors_that_never_recorded_together_are_named(place, tmp_path):
    site = place()
    table = pq.read_table(SAMPLE / "R2.parquet")
    later = table.set_column(0, "time", pc.add(table["time"], 3600.0))
    (tmp_path / "R2.parquet").unlink()
    pq.write_table(later, tmp_path / "R2.parquet")
    (warning,) = gr.check_site(site).warnings
    assert warning.startswith("R1 and R2 have no time in common: 3,500 s lie between them")
    (tmp_path / "clocks.json").write_text('{"clocks": {"R2": {"offset_s": 3600}}}', "utf-8")
    text = site.read_text(encoding="utf-8")
    site.write_text(text.replace("[measure]", '[measure]\nclocks = "clocks.json"'), "utf-8")
    assert not gr.check_site(site).warnings  # the run corrects it


@pytest.mark.parametrize(
    ("later_s", "said"),
    [
        (-315_964_782.0, "R2.parquet: times begin at 2015-06-08 09:30"),
        (18.0, "R2.parquet: its last frame is 18 s later than the file was written: is the clock"),
        (7200.0, "R2.parquet: its last frame is 7,200 s later than the file was written"),
        (0.0, ""),
        (2e7, ""),  # some archives give all files one time
    ],
)  # fmt: skip
@pytest.mark.usefixtures("unjudged")
def test_times_that_cannot_be_are_named(place, tmp_path, later_s, said):
    """All sensors of a site: by each other they are right."""
    site = place()
    for name in ("R1", "R2"):
        table = pq.read_table(SAMPLE / f"{name}.parquet")
        last = table["time"].to_numpy()[-1]
        (tmp_path / f"{name}.parquet").unlink()
        shifted = table.set_column(0, "time", pc.add(table["time"], later_s))
        pq.write_table(shifted, tmp_path / f"{name}.parquet")
        os.utime(tmp_path / f"{name}.parquet", (last, last))
    warnings = gr.check_site(site).warnings
    assert [each for each in warnings if each.startswith("R2")] == (
        [each for each in warnings if said and each.startswith(said)]
    )
    assert bool(warnings) == bool(said)


def with_rates(site, factor):
    """Multiply the range rates of R2 beside a site file."""
    path = site.with_name("R2.parquet")
    table = pq.read_table(path)
    at, field = table.column_names.index("range_rate"), table.schema.field("range_rate")
    path.unlink()  # a link to the sample
    rates = pc.multiply(table["range_rate"], factor).cast(field.type)
    pq.write_table(table.set_column(at, field, rates), path)
    return site


def test_signs_are_judged_before_a_pose_is_found(place):
    found = gr.check_site(with_rates(place(), -1.0))
    (finding,) = found.findings
    assert (finding.sensor, finding.verdict) == ("R2", "does not fit")
    assert "range rates look positive where targets approach" in finding.cause
    assert found.failure.exit_code == 4


def test_the_table_of_a_check_is_german_for_whom_asks_for_it(place, monkeypatch):
    """As QGIS does, which shows it: units are judged before a pose is found."""
    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "de")
    done = CliRunner().invoke(group, ["check", str(with_rates(place(), 3.6)), "--json"])
    (answer,) = (line for line in done.stdout.splitlines() if '"result"' in line)
    rows = json.loads(answer)["summary"]["plausibility"]
    assert rows[1][:2] == ["R2", "passt nicht"]
    assert re.search("Radialgeschwindigkeiten .*km/h", rows[1][2])
    assert done.exit_code == 4 or done.exception.exit_code == 4


def test_a_recording_in_which_nothing_moves_is_named_before_a_pose_is_sought(place):
    found = gr.check_site(with_rates(place(), 0.0))
    assert found.failure is None
    little = "R2: too little traffic to tell: 0 vehicles move, 10 are needed"
    assert found.warnings == (f"{little}; no range rate is over 0.15 m/s",)


def test_short_and_foreign_recordings(place, tmp_path):
    site = place(('recordings = ["R2.parquet"]', 'recordings = ["R2.pcap"]'))
    shutil.copyfile(SAMPLE / "R2.parquet", tmp_path / "R2.pcap")  # opened by the run only
    table = pq.read_table(SAMPLE / "R1.parquet")
    (tmp_path / "R1.parquet").unlink()
    short = pc.less(table["time"], table["time"][0].as_py() + 30.0)
    pq.write_table(table.filter(short), tmp_path / "R1.parquet")
    found = gr.check_site(site)
    assert found.figures()["sensors"]["R2"] == {"recordings": "converted by the run"}
    assert [line.partition(" rarely")[0] for line in found.warnings] == [
        "R1: 30 s in one recording"
    ]


@pytest.mark.parametrize("console", [JsonConsole, TerminalConsole])
def test_messages_in_the_language_that_is_asked_for(monkeypatch, console):
    assert console().translated("warning") == "warning"
    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "de")
    assert console().translated("warning") == "Warnung"
    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "C")
    assert console().translated("warning") == "warning"


def test_programs_get_english_in_any_country(monkeypatch):
    monkeypatch.setenv("LANGUAGE", "de")
    assert JsonConsole().translated("warning") == "warning"
    assert TerminalConsole().translated("warning") == "Warnung"


def test_an_error_of_a_command_in_german(place, monkeypatch):
    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "de")
    site = place(("690356.0, 5336183.0", "691356.0, 5336183.0"))
    with pytest.raises(gr.InputError) as caught:
        gr.check_site(site)
    german = TerminalConsole().translated(caught.value.message)
    assert german.startswith("R1 steht ")
    assert german.endswith(" m vom nächsten Fahrstreifen der Karte entfernt")
    assert TerminalConsole().translated(caught.value.hint).startswith("die Position gilt im")
