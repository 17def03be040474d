"""The report's words in German: none is missing, none is left in English."""

from __future__ import annotations

import ast
import re
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import pypdf
import pytest
from message_templates import message_templates, plain
from report_site import Page, write_results, write_run

import gis_radar as gr
from gis_radar.heatmap import MapLabels
from gis_radar.languages import catalogue, messages
from gis_radar.words import (
    figure_text,
    listed,
    long_day,
    percent,
    plural,
    seconds_text,
    speaking,
    stage_words,
    tr,
    tr_message,
)

PACKAGE = Path(gr.__file__).parent
PLACES = {"tr": slice(0, 1), "plural": slice(1, 3)}
# Read as they are in both languages: names of the data, of files and of places, units, signs.
SAME = re.compile(
    r".*\.(csv|osm|parquet|laz)\b.*|R\d|Sensors?|Software|Scan|Radar.*|gis_radar.*|[0-9a-f]{32,}|"
    r"ours & theirs|Town of .*|.*<.?script>.*|Kreuzung Süd.*|Name|.*Europe/Berlin.*|.*ETRS89.*|"
    r"Pause|(m|s|h|min|UTC|N)|[\W\d]*\d[\W\d]*(m|min|s|h)?[\W\d]*|[\d\W_]*"
)


def asked_for():
    """Return the texts in calls of `tr` and `plural`, in templates and in the definitions."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in PLACES:
                for each in node.args[PLACES[node.func.id]]:
                    parts = [each.body, each.orelse] if isinstance(each, ast.IfExp) else [each]
                    found |= {part.value for part in parts if isinstance(part, ast.Constant)}
    for path in (
        PACKAGE / "report/page.html",
        PACKAGE / "site/summary.md.jinja",
        PACKAGE / "live/web/page.html",
    ):
        found |= set(re.findall(r'tr\("([^"]+)"', path.read_text(encoding="utf-8")))
    text = (PACKAGE / "report" / "definitions.toml").read_text(encoding="utf-8")
    for group in tomllib.loads(text).values():
        found |= {*group, *group.values()}
    return found


def test_no_text_that_is_asked_for_lacks_its_german():
    assert len(asked_for()) > 200
    assert sorted(asked_for() - set(catalogue("de"))) == []


def test_each_error_hint_and_warning_has_its_german_and_no_german_is_left_of_old_ones():
    asked = message_templates()
    elsewhere = {plain(re.sub(r"\{\w*\}", "{}", text)) for text in catalogue("de")}
    german = set(messages("de"))
    assert len(asked) > 700
    missing = {each: where for each, where in asked.items() if each not in elsewhere | german}
    assert missing == {}
    assert sorted(german - set(asked)) == []


def test_each_german_message_is_found_again_with_the_values_of_the_english_one():
    assert len(messages("de")) > 700
    wrong = {}
    with speaking("de"):
        for text, german in messages("de").items():
            values = [f"V{place}" for place in range(text.count("{}"))]
            told, expected = text, german
            for place, value in enumerate(values):
                told = told.replace("{}", value, 1)
                expected = expected.replace(f"{{{place}}}", value)
            if tr_message(f"R1: {told}") != f"R1: {expected}":
                wrong[told] = tr_message(f"R1: {told}")
    assert wrong == {}


@pytest.mark.parametrize(
    ("told", "german"),
    [
        ("a/b: c.parquet: recording without rows", "a/b: c.parquet: Aufzeichnung ohne Zeilen"),
        ("the scans lie 1.25 m over the map's heights: another vertical datum?",
         "die Laserscans liegen 1,25 m über den Höhen der Karte: ein anderes Höhensystem?"),
        ("R1: no usable frame in the inputs; R2: 3 frames, at least 20 are needed",
         ("R1: kein brauchbarer Messzyklus in den Eingaben; "
          "R2: 3 Messzyklen, nötig sind mindestens 20")),
        ("clock of R2: their clocks run apart by 12.5%",
         "Uhr von R2: ihre Uhren laufen um 12,5\u202f% auseinander"),
        ("this and that of a library", "this and that of a library"),
    ],
)  # fmt: skip
def test_errors_are_german_wherever_they_stand(told, german):
    with speaking("de"):
        assert tr_message(told) == german


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Write the same report in both languages."""
    folder = write_results(tmp_path_factory.mktemp("site"))
    write_run(folder, title="Kreuzung Süd")
    return {
        name: gr.write_report(folder, output=tmp_path_factory.mktemp(name), language=name)
        for name in ("en", "de")
    }


@pytest.fixture(scope="module")
def reports(written):
    """Return where the reports are."""
    return {name: made.outputs[0].parent for name, made in written.items()}


def test_a_run_logs_what_a_german_report_found_as_all_else_in_english(written):
    """The console translates for who wants German; here it would be one line among English."""
    found = [made.summary["found"] for made in written.values()]
    assert found[0] == found[1]
    assert found[0][0].startswith("Recorded were")
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


def test_tables_are_the_same_in_every_language(reports):
    for name in ("lanes.csv", "lanes_by_interval.csv", "sensors.csv", "quality.csv"):
        assert (reports["en"] / name).read_bytes() == (reports["de"] / name).read_bytes()


def test_german_numbers_and_days():
    moment = datetime(2025, 3, 12, 9, tzinfo=UTC)
    with speaking("de"):
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


def test_a_finished_sentence_is_known_again_with_its_values():
    told = "The pose of sensor R2 is in EPSG:25833, the map in EPSG:25832: it is left out."
    with speaking("de"):
        german = "Der Standort von Sensor R2 ist in EPSG:25833 angegeben, die Karte in EPSG:25832:"
        assert tr_message(told).startswith(german)
        assert tr_message("no sentence of ours") == "no sentence of ours"
    assert tr_message(told) == told


@pytest.mark.parametrize(
    ("told", "german"),
    [
        ("the scan covers 96% of the view of R2: what it does not cover counts as in sight",
         "der Scan deckt 96 % des Sichtfelds von R2 ab: Was er nicht abdeckt, zählt als einsehbar"),
        ("R1: frozen: 3 % of the frames repeat the last (in 2 of its hours, first in that from x)",
         ("R1: eingefroren: 3 % der Messzyklen wiederholen den vorigen (in 2 seiner Stunden, "
         "zuerst in der ab x)")),
        (("localize R1: scan check: confirms: 93% of what stands lies on the scan's canopy and "
          "walls, by chance 19%; most of all 0.1 m and 0.2 deg away"),
         ("Standort und Ausrichtung suchen: R1: Gegenprobe mit dem Laserscan: bestätigt: 93\u202f% "
          "dessen, was steht, liegt im Laserscan auf Kronen und Wänden, zufällig wären es "
          "19\u202f%; am besten passt es 0,1 m und 0,2 Grad entfernt")),
        ("localize R1, tiles: a.osm: 4 lanelets repaired, see layer problems",
         ("Standort und Ausrichtung suchen: R1, Kacheln: a.osm: 4 Lanelets ausgebessert, siehe "
          "Layer „problems“")),
        ("poses together: R2: alone: no other sensor sees enough of the same vehicles",
         ("Standorte und Ausrichtungen gemeinsam: R2: allein: kein anderer Sensor sieht genug von "
          "denselben Fahrzeugen")),
        ("report: Recorded were 100 s only: a few cycles of a signal, and no usual day",
         ("Bericht: Aufgezeichnet sind nur 100 s: wenige Umläufe einer Ampel, kein gewöhnlicher "
          "Tag")),
        (("a.parquet: 99.9 % of the detections lie within 120 m, but the view of R1 reaches 300 m: "
         "what lies beyond reads as observed and empty; set max_range_m in [sensor.view]"),
         ("a.parquet: 99,9 % der Detektionen liegen innerhalb von 120 m, aber das Sichtfeld von R1 "
         "reicht 300 m weit: Was dahinter liegt, erscheint beobachtet und leer; max_range_m in "
         "[sensor.view] setzen")),
    ],
)  # fmt: skip
def test_warnings_of_a_run_are_german(told, german):
    with speaking("de"):
        assert tr_message(told) == german


def test_one_german_word_for_each_word_of_the_data():
    """A frame is a Messzyklus, a detection a Detektion; Messung is neither, nor a recording."""
    told = {**catalogue("de"), **messages("de")}
    others = re.compile(r"(sensor|map) frame|^frames: ")  # of coordinates; a file
    wrong = [
        (text, german) for text, german in told.items()
        if (re.search(r"\bframes?\b", others.sub("", text), re.IGNORECASE)
            and "Messzykl" not in german)
        or (re.search(r"\bdetections?\b", text) and "etektion" not in german)
        or re.search(r"\b[Mm]essung", german)
    ]  # fmt: skip
    assert wrong == []


def test_each_stage_of_a_run_has_its_german():
    tree = ast.parse((PACKAGE / "site" / "plan.py").read_text(encoding="utf-8"))
    named = [
        word.value for node in ast.walk(tree) if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") == "Stage" for word in node.keywords if word.arg == "name"
    ]  # fmt: skip
    firsts = [each.values[0] if isinstance(each, ast.JoinedStr) else each for each in named]
    begins = {each.value.strip() for each in firsts if isinstance(each, ast.Constant)}
    assert len(begins) > 9
    with speaking("de"):
        assert [each for each in begins if stage_words(f"{each} R1") == f"{each} R1"] == []
        assert [
            each for each in begins
            if tr_message(f"{each}: no usable frame in the inputs").startswith(f"{each}:")
        ] == []  # fmt: skip


def test_names_of_sensors_are_no_words_of_the_catalogue():
    told = "the scan covers 96% of the view of Map: what it does not cover counts as in sight"
    with speaking("de"):
        assert "Sichtfelds von Map ab" in tr_message(told)


def test_a_language_that_is_none(tmp_path):
    with pytest.raises(gr.UsageError, match="'fr'"):
        MapLabels(language="fr")
