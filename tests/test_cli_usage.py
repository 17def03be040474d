"""Wrong usage in German: what click says is in our catalogue, all of it that our commands meet."""

import re
import sys

import pytest

from gis_radar.cli.usage import CLICK_TEXTS

SHORT = ("tiles", "a.osm", "-o", "a.gpkg")
# What click says (a template of ours), words that make it say so, and what is read in German.
SAID = [
    ("Missing argument {}.", ("tiles",), "Es fehlt die Angabe 'MAP.osm'."),
    ("Missing option {}.", ("tiles", "a.osm"), "Es fehlt die Option '-o' / '--output'."),
    ("Missing command.", ("--", ), "Es fehlt der Befehl."),
    ("Got unexpected extra argument ({})", (*SHORT, "b"), "Diese Angabe ist zu viel: b"),
    ("Got unexpected extra arguments ({})", (*SHORT, "b", "c"), "Diese Angaben sind zu viel: b c"),
    ("Option {} requires an argument.", ("tiles", "a.osm", "-o"),
     "Die Option '-o' braucht einen Wert."),
    ("Option {} does not take a value.", (*SHORT, "--json=1"),
     "Die Option '--json' nimmt keinen Wert."),
    ("No such command {}.", ("nothing",), "Den Befehl 'nothing' gibt es nicht."),
    ("No such command {}. Did you mean {}?", ("tile",),
     "Den Befehl 'tile' gibt es nicht. Ist 'tiles' gemeint?"),
    ("No such option {}.", (*SHORT, "--zzz"), "Die Option '--zzz' gibt es nicht."),
    ("No such option {}. Did you mean {}?", (*SHORT, "--outptu", "b"),
     "Die Option '--outptu' gibt es nicht. Ist '--output' gemeint?"),
    ("{} is not a valid float.", (*SHORT, "--length", "long"),
     "Falscher Wert für '--length': 'long' ist keine Zahl."),
    ("{} is not a valid integer.", ("run", "S.toml", "-o", "r", "--jobs", "1.5"),
     "Falscher Wert für '--jobs': '1.5' ist keine ganze Zahl."),
    ("{} is not one of {}.", ("report", "r", "--csv-locale", "fr"),
     "Falscher Wert für '--csv-locale': 'fr' ist keines von 'en', 'de'."),
    ("Invalid value for {}: {}", ("convert", "a", "-o", "b", "--duration", "x"),
     "Falscher Wert für '--duration': "),
]  # fmt: skip


@pytest.mark.parametrize(("template", "words", "german"), SAID, ids=[each[0] for each in SAID])
def test_what_click_says_is_german(run, monkeypatch, template, words, german):
    pattern = ".*".join(map(re.escape, template.split("{}")))
    code, _, english = run(*words)
    assert (code, len(english.splitlines())) == (2, 1)
    assert re.search(pattern, english)
    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "de")
    code, _, told = run(*words)
    assert code == 2
    assert told.startswith(f"gis-radar: {german}")
    assert "(try " not in told
    assert not re.search(pattern, told)


def test_each_text_of_the_list_is_met():
    """But for names that are near to several others: which, is click's to say."""
    left = [text for text in CLICK_TEXTS if text not in {each[0] for each in SAID}]
    assert [text for text in left if "one of: " not in text] == []


def test_the_bare_command_shows_its_help(run):
    """In lines as they are, not as one line of an error."""
    code, out, err = run()
    assert code == 2
    assert len((out + err).splitlines()) > 20
    assert "gis-radar:" not in out + err
    assert sys.argv == ["gis-radar"]
