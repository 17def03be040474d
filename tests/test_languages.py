"""The report's words in German: none is missing, none is left in English."""

from __future__ import annotations

import csv
import json
import pickle
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pypdf
import pytest
from report_site import Page, reports_of_whole_run

import gis_radar as gr
from gis_radar.base import (
    Text,
    figure_text,
    in_language,
    listed,
    percent,
    plural,
    restored,
    seconds_text,
    tr,
    users_language,
    with_texts,
)
from gis_radar.base.languages import catalogue
from gis_radar.base.words import long_day
from gis_radar.cli.result_tables import as_lines, as_title, is_table
from gis_radar.products import MapLabels
from tools import catalogue as tool

HOLE = re.compile(r"\{(\w*)((?::[^}]*)?)\}")
# Read as they are in both languages: names of the data, of files and of places, units, signs.
SAME = re.compile(
    r".*\.(csv|osm|parquet|laz)\b.*|R\d|Sensors?|Software|Scan|Radar.*|gis_radar.*|[0-9a-f]{32,}|"
    r"ours & theirs|Town of .*|.*<.?script>.*|Kreuzung .*|Name|.*Europe/Berlin.*|.*ETRS89.*|"
    r"Pause|(m|s|h|min|UTC|N)|[\W\d]*\d[\W\d]*(m|min|s|h)?[\W\d]*|[\d\W_]*"
)


def test_each_text_has_its_german_and_no_german_is_left_of_old_ones():
    asked, german = tool.asked(), catalogue("de")
    assert len(asked) > 1000
    assert {text: where for text, where in asked.items() if not german.get(text)} == {}
    assert tool.unused(set(german)) == []


def test_no_text_is_finished_where_a_user_is_told_it():
    finished = [f"{where}: {text}" for where, text in tool.told() if text[:2] in {"f'", 'f"'}]
    assert [each for each in finished if re.search("[A-Za-z]{2} ", each.partition(": ")[2])] == []


def test_columns_of_layers_have_their_german():
    styles = "".join(each.read_text() for each in tool.PACKAGE.rglob("*.qml"))
    names = set(re.findall(r'<alias .*name="(.*?)"', styles))
    assert {"Lane", "Tile", "Yaw (deg)"} <= names <= set(catalogue("de"))


def test_the_catalogue_is_as_the_tool_writes_it():
    """And read without Babel as Babel reads it."""
    before = tool.GERMAN.read_text(encoding="utf-8")
    assert tool.read() == catalogue("de")
    tool.write(tool.read())
    assert tool.GERMAN.read_text(encoding="utf-8") == before


def test_holes_of_a_translation_are_those_of_its_text():
    for text, german in catalogue("de").items():
        holes = re.findall(HOLE, text.replace("{{", "").replace("}}", ""))
        asked = [name or str(place) for place, (name, _) in enumerate(holes)]
        given = re.findall(HOLE, german)
        assert sorted(name for name, _ in given) == sorted(asked), text
        assert sorted(spec for _, spec in given) == sorted(spec for _, spec in holes), text


def test_texts_pass_between_processes_and_through_files():
    inner = Text("{}: {:,} rows", Path("R1.parquet"), np.int64(12_000))
    error = gr.InputError("{}: {}", "R1", inner, hint=Text("at least {:g}", np.float32(0.5)))
    back = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    document = {"told": [error.message, "as it is"], "by": {"R1": error.hint}}
    read = restored(json.loads(json.dumps(with_texts(document))))
    assert read == document
    for told in (error.message, back.message, str(back), read["told"][0]):
        assert told == "R1: R1.parquet: 12,000 rows"
        assert (told.template, told.values[1].template) == ("{}: {}", "{}: {:,} rows")
    assert (back.hint.values, read["by"]["R1"].values) == ((0.5,), (0.5,))
    assert with_texts({"a": "no text"}) == {"a": "no text"}


@pytest.mark.parametrize(
    "told",
    [Text('cycle = "{1}ms" in [[sensor]] {0}', "R1", 57), Text("a key for {{{}}}", "--scan"),
     Text("max_range_m in [sensor.view]", "--max-range"), Text("{:+.3f} s, {:.1%}", 0.5, 0.1)],
)  # fmt: skip
def test_a_text_that_a_file_holds_is_the_same_again(told):
    (read,) = restored(json.loads(json.dumps(with_texts({"told": [told]}))))["told"]
    assert (read, read.template, read.values) == (told, told.template, told.values)


@pytest.mark.parametrize(
    "entry",
    [
        ["{} {}", 1],
        ["{2}", 1],
        ["{} {0}", 1],
        ["{", 1],
        ["}", 1],
        ["{0.__class__}", 1],
        ["{:999999999}", 1],
        ["{:{}}", 1, 2],
        ["{x}", 1],
        {},
        3,
    ],
)
def test_what_a_file_claims_to_be_a_text_is_none(entry):
    """A record may be anybody's: its templates look into nothing and fill no memory."""
    read = restored({"told": "as it is", "texts": {"as it is": entry}})
    assert read == {"told": "as it is"}
    assert not isinstance(read["told"], Text)


def test_a_name_before_a_text_is_taken_off():
    reason = Text("{} frames, at least {} are needed", 3, 20)
    left = Text("{}: {}", "R1", reason).without("R1")
    assert (left, Text(left.values[0]).template) == (reason, reason.template)
    left = Text("{}", Text("{}: {} gives no pose", "R1", "a")).without("R1")
    assert (left, left.template) == ("a gives no pose", "{} gives no pose")
    for other in (Text("R1: as it is"), Text("{}: {}", "R2", reason), Text("R1")):
        assert other.without("R1") is other


@pytest.mark.parametrize(
    ("told", "german"),
    [
        (Text("{}: recording without rows", Path("a/b: c.parquet")),
         "a/b: c.parquet: Aufzeichnung ohne Zeilen"),
        (Text("the scans lie {:.2f} m over the map's heights: another vertical datum?", 1.25),
         "die Laserscans liegen 1,25 m über den Höhen der Karte: ein anderes Höhensystem?"),
        (Text("; ").join([Text("{}: {}", "R1", Text("no usable frame in the inputs")),
                       Text("{}: {} frames, at least {} are needed", "R2", 3, 20)]),
         ("R1: kein brauchbarer Messzyklus in den Eingaben; "
          "R2: 3 Messzyklen, nötig sind mindestens 20")),
        (Text("{}: {}", "R2", Text("their clocks run apart by {:.1%}", 0.125)),
         "R2: ihre Uhren laufen um 12,5\u202f% auseinander"),
        (Text("{}: {:,} fragmented datagrams are not complete", "a.pcap", 12_000),
         "a.pcap: 12\u202f000 zerlegte Datagramme sind unvollständig"),
        ("this and that of a library", "this and that of a library"),
        (Text("{}: {}", "R1", "this and that of a library"), "R1: this and that of a library"),
        (Text(" or ").join([Text("x and y are swapped"), Text("its yaw counts clockwise")]),
         "x und y sind vertauscht oder yaw zählt im Uhrzeigersinn"),
        (Text("{}: {}: {}", "R1", Text("fits"), Text("its pose may be off")),
         "R1: passt: der Standort ist vielleicht falsch"),
        # names of sensors and files are no words of the catalogue
        (Text("no tile lies in the view of {}", "Map"), "keine Kachel liegt im Sichtfeld von Map"),
    ],
)  # fmt: skip
def test_errors_are_german_wherever_they_stand(told, german):
    assert tr(told) == told
    (read,) = restored(json.loads(json.dumps(with_texts({"told": [told]}))))["told"]
    with in_language("de"):
        assert tr(told) == tr(read) == german


@pytest.mark.parametrize(
    ("variables", "language"),
    [({}, "en"), ({"LANG": "de_DE.UTF-8"}, "de"), ({"LANG": "fr_FR.UTF-8"}, "en"),
     ({"LC_MESSAGES": "de_AT", "LANG": "en_US"}, "de"), ({"LC_ALL": "C", "LANG": "de_DE"}, "en"),
     ({"LANGUAGE": "fr:de:en", "LC_ALL": "en_GB"}, "de"), ({"LANGUAGE": "", "LANG": "de"}, "de"),
     ({"GIS_RADAR_LANGUAGE": "en", "LANG": "de_DE"}, "en")],
)  # fmt: skip
def test_the_terminal_speaks_the_language_of_the_user(monkeypatch, variables, language):
    for name in ("GIS_RADAR_LANGUAGE", "LANGUAGE", "LC_ALL", "LC_MESSAGES", "LANG"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert users_language() == language
    assert users_language(chosen_only=True) == "en"


@pytest.fixture(scope="module")
def written(once):
    """The same report in both languages."""
    return reports_of_whole_run(once)


@pytest.fixture(scope="module")
def reports(written):
    """Return where the reports are."""
    return {name: made.outputs[0].parent for name, made in written.items()}


def test_a_run_logs_what_a_german_report_found_as_all_else_in_english(written):
    """The console translates for who wants German; here it would be one line among English."""
    found = [made.summary["found"] for made in written.values()]
    assert found[0] == found[1]
    assert found[0][0].startswith("Only ")
    assert written["de"].summary["remarks"][0].startswith("Aufgezeichnet sind")


def test_no_words_of_a_german_report_are_english(reports):
    texts = {}
    for name, place in reports.items():
        page = Page((place / "report.html").read_text(encoding="utf-8"))
        shown = {" ".join(each.split()) for each in page.words}
        named = {value for _, attributes in page.attributes for key, value in attributes.items()
                 if key in {"alt", "aria-label", "data-label"} and value}  # fmt: skip
        texts[name] = {each for each in shown | named if "{" not in each[:3]}
    css_and_script = {each for each in texts["de"] if "--ink" in each or "use strict" in each}
    left = texts["en"] & texts["de"] - css_and_script
    assert sorted(each for each in left if not SAME.fullmatch(each)) == []
    assert len(texts["de"]) > 100


def test_the_paper_is_german(reports):
    paper = pypdf.PdfReader(reports["de"] / "report.pdf")
    text = " ".join(page.extract_text() for page in paper.pages)
    assert paper.root_object["/Lang"] == "de"
    assert "Alle Zeiten: Europe/Berlin, UTC+02:00." in text
    assert "15. Juni 2025, 17:06:40 bis 17:07:40" in text
    assert "678\u202f000,00" in text
    assert "Seite 1 von" in text
    for english in ("What", "Lane ", "Recorded", "observed", " to "):
        assert english not in text, english
    words = {each.strip("()[]:;,„“") for each in text.split()}
    parts = zip(*catalogue("de").items(), strict=True)
    english, german = (set(re.findall(r"[^\W\d_]{3,}", " ".join(each))) for each in parts)
    # a name of EPSG; the site's own words
    assert words & (english - german) <= {"zone", "ours", "theirs", "Town"}
    assert "Fahrstreifen" in words


def test_tables_are_the_same_in_every_language_but_for_words(reports):
    for name in ("lanes.csv", "lanes_by_interval.csv"):
        assert (reports["en"] / name).read_bytes() == (reports["de"] / name).read_bytes()
    tables = [
        csv.DictReader((reports[each] / "quality.csv").read_text(encoding="utf-8").splitlines())
        for each in ("en", "de")
    ]
    rows = list(zip(*tables, strict=True))
    differ = {name for one, other in rows for name in one if one[name] != other[name]}
    assert differ == {"weekday", "verdict"}


def test_german_numbers_and_days():
    moment = datetime(2025, 3, 12, 9, tzinfo=UTC)
    with in_language("de"):
        assert figure_text(1234567.891, 1) == "1\u202f234\u202f567,9"
        assert percent(0.0004) == "unter 0,1\u202f%"
        assert long_day(moment) == "12. März 2025"
        assert listed(["a", "b", "c"]) == "a, b und c"
        assert plural(1, "{n} track", "{n} tracks") == "1 Spur"
        assert tr("a text that nobody has put into German") == (
            "a text that nobody has put into German"
        )
    assert percent(0.0004) == "under 0.1\u202f%"
    assert long_day(moment) == "12 March 2025"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(5.25, "5.2 s"), (100.0, "100 s"), (200.0, "3 min 20 s"), (85_500.0, "23 h 45 min"),
     (86_400.0, "1 d"), (90_061.0, "1 d 1 h")],
)  # fmt: skip
def test_durations(seconds, text):
    assert seconds_text(seconds).replace("\u202f", " ") == text


def test_the_terminal_shows_figures_in_german():
    """No comma sets thousands apart where it is the decimal sign."""
    figures = {"points_in": 322924, "density_per_m2": 9.212, "easting": 690360.09,
               "sigma_yaw": 0.089, "observable": False}  # fmt: skip
    with in_language("de"):
        shown = {as_title(name): as_lines(name, value) for name, value in figures.items()}
    assert shown == {
        "gelesene Punkte": "322\u202f924", "Punkte je m²": "9,212", "Ostwert": "690\u202f360,09",
        "sigma Gierwinkel": "0,089", "eindeutig bestimmbar": "nein",
    }  # fmt: skip
    assert as_lines("points_in", 322924) == "322,924"


def test_figures_by_name_are_lines_and_none_is_said():
    changed = {"queue_max_m, more": 1, "speed_kmh, less": 2}
    assert as_lines("lanes_with_a_change", changed) == "queue_max_m, more: 1\nspeed_kmh, less: 2"
    with in_language("de"):
        assert as_lines("all_stop_lines", {"n": Text("yes")}) == "n: ja"
        assert as_lines("all_stop_lines", {}) == "keine"
    assert not is_table({})


def test_a_language_that_is_none(tmp_path):
    with pytest.raises(gr.UsageError, match="'fr'"):
        MapLabels(language="fr")
