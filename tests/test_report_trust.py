"""The report's page *Can this be trusted?*: a row a sensor, in the words of the check."""

import json
from dataclasses import replace

import pytest
from report_site import Page, write_results, write_run

import gis_radar as gr
from gis_radar.base import NO_FIGURE, Text, with_texts
from gis_radar.calibration import FITS, UNKNOWN, WRONG, Finding
from gis_radar.calibration.findings import RECORD_MORE

DRIVE = Text(
    "with this pose {:.0%} of {} recorded vehicles drive along lanes of the map", 0.96, 48
)  # fmt: skip
TURNED = Finding(
    sensor="R2", verdict=WRONG, evidence=Text("{}, {:.0%} after this correction", DRIVE, 1.0),
    cause=Text("from {} on: {}", "2025-06-15T15:06:50Z", Text("yaw is off by 180 deg")),
    advice=Text("set yaw to {:.1f} deg", 21.7),
)  # fmt: skip
FOUND = [
    Finding(sensor="R1", verdict=FITS, evidence=DRIVE),
    TURNED,
    Finding(sensor="R3", verdict=UNKNOWN, evidence=DRIVE, advice=RECORD_MORE),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results of a run that left R3 out; R1 fits, R2 was accepted, R4 was never checked."""
    made = write_results(tmp_path_factory.mktemp("trust"), names=("R1", "R2", "R4"))
    path = made / "dataset" / "dataset.json"
    checks = {each.sensor: each.record for each in FOUND[:2]}
    document = with_texts(json.loads(path.read_text(encoding="utf-8")) | {"checks": checks})
    path.write_text(json.dumps(document), encoding="utf-8")
    left_out = {each.sensor: each.record for each in FOUND[2:]}
    stage = {"name": "measure", "figures": {"findings": left_out}}
    write_run(made, title="A", **with_texts({"stages": [stage]}))
    return made


def trust(folder, language, tmp_path):
    gr.write_report(folder, output=tmp_path / language, language=language)
    text = (tmp_path / language / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    heads = {"en": "Verdict", "de": "Urteil"}
    # the table of quality has a verdict, too, as its last column
    rows = next(table for table in page.tables if table[0][1].strip() == heads[language])
    return [[cell.replace("\u202f", " ").strip() for cell in row] for row in rows], text


def test_a_row_a_sensor(folder, tmp_path, blank_paper):
    (heads, *rows), text = trust(folder, "en", tmp_path)
    assert heads == ["Sensor", "Verdict", "Evidence", "What to do"]
    assert "Can this be trusted?" in text
    assert rows[0] == ["R1", "fits", str(DRIVE), NO_FIGURE]
    assert rows[1][:2] == ["R2", "does not fit, accepted anyway"]
    assert rows[1][2].startswith(
        "from 2025-06-15 17:06:50 UTC+02:00 on: yaw is off by 180 deg (with this pose 96%"
    )
    assert rows[1][3] == "set yaw to 21.7 deg"
    assert rows[2][:2] == ["R3", "too little traffic to tell"]
    assert rows[2][3] == "record more traffic"
    assert rows[3] == ["R4", "not checked", NO_FIGURE, NO_FIGURE]
    assert "1 sensor of this map fits. Where one does not fit, do not use this map" in text


def test_a_sensor_that_is_left_out_is_named_once_in_the_time_of_the_site(tmp_path, blank_paper):
    (tmp_path / "made").mkdir()
    made = write_results(tmp_path / "made", names=("R1",))
    found = {"findings": {"R1": FOUND[0].record, "R2": TURNED.record}}
    warning = Text("{} is left out: {}", "R2", TURNED.text_with_advice)
    stage = {
        "name": "measure", "warnings": [warning],
        "figures": {**found, "refused": {"R2": Text("{}: {}", "R2", TURNED.text)}},
    }  # fmt: skip
    write_run(made, title="A", **with_texts({"stages": [stage]}), sensors_in_heat_maps=["R1"])
    document = json.loads((made / "run.json").read_text())
    document["site"]["sensor"] = [{"name": "R1"}, {"name": "R2"}]
    (made / "run.json").write_text(json.dumps(document))
    _, text = trust(made, "en", tmp_path)
    assert text.count("R2: does not fit: from 2025-06-15 17:06:50 UTC+02:00 on") == 1
    assert "R2 is left out" not in text
    assert "15:06:50Z" not in text
    assert "1 sensor of this map fits." in text
    assert "All sensors" not in text
    document["sensors_in_heat_maps"] = ["R1", "R2"]  # with what was measured before
    (made / "run.json").write_text(json.dumps(document))
    assert "R2 is left out" in trust(made, "en", tmp_path)[1]


def test_a_sensor_whose_earlier_recordings_are_used_is_not_said_to_be_accepted(
    tmp_path, blank_paper
):
    (tmp_path / "made").mkdir()
    made = write_results(tmp_path / "made", names=("R1", "R2"))
    path = made / "dataset" / "dataset.json"
    earlier = replace(FOUND[0], sensor="R2")  # what is in the map fits
    checks = {"R1": FOUND[0].record, "R2": earlier.record}
    document = with_texts(json.loads(path.read_text(encoding="utf-8")) | {"checks": checks})
    path.write_text(json.dumps(document), encoding="utf-8")
    figures = {
        "findings": {"R1": FOUND[0].record, "R2": TURNED.record},
        "refused": {"R2": Text("{}: {}", "R2", TURNED.text)},
    }
    stages = [{"name": "measure", "figures": figures}]
    write_run(made, title="A", **with_texts({"stages": stages}), sensors_in_heat_maps=["R1", "R2"])
    (_, *rows), text = trust(made, "en", tmp_path)
    assert rows[1][:2] == ["R2", "does not fit, used in part"]
    assert "All sensors of this map fit." in text
    assert "do not use this map" not in text


def test_in_german(folder, tmp_path, blank_paper):
    (_, *rows), text = trust(folder, "de", tmp_path)
    assert "Kann man dem trauen?" in text
    drive = "mit diesem Standort fahren 96 % von 48 aufgezeichneten Fahrzeugen auf Fahrstreifen"
    assert rows[0][1:3] == ["passt", f"{drive} der Karte"]
    assert rows[1][1] == "passt nicht, trotzdem übernommen"
    assert "15.06.2025 17:06:50" in rows[1][2]
    assert rows[3][1] == "nicht geprüft"
