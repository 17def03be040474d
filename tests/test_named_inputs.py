"""A message names the file and the place in it, also where what raises it knows neither."""

import json
import pickle
import traceback

import pandas as pd
import pytest

import gis_radar as gr
from gis_radar.base import CrsError, InputError, Text, placed, seconds_from_iso
from gis_radar.recordings import open_recording
from gis_radar.site import files_of
from gis_radar.site.messages import error_in_site_words

POSE = json.loads((gr.sample_folder() / "R1.json").read_text())
WRONG = {
    "view: azimuth_deg is 400": {"view": {"azimuth_deg": 400}},
    "view: elevation_deg is 0": {"view": {"elevation_deg": 0}},
    "view: range is 5.0 to 2.0 m": {"view": {"min_range_m": 5, "max_range_m": 2}},
    "covariance": {"covariance": [[1.0] * 6] * 5},
    "sigma": {"sigma": {"easting": -1.0}},
}


@pytest.mark.parametrize("told", WRONG)
def test_a_pose_that_cannot_be_names_its_file(tmp_path, told):
    (tmp_path / "P.json").write_text(json.dumps(POSE | WRONG[told]))
    with pytest.raises(InputError, match=rf"/P\.json: .*{told}"):
        gr.read_pose(tmp_path / "P.json")


def test_a_pose_of_a_track_names_its_row(tmp_path):
    pose = gr.read_pose(gr.sample_folder() / "R1.json")
    since = [seconds_from_iso("2025-06-12T07:30:00Z", what="")]
    gr.PoseTrack(poses=(pose,), since=since).write(tmp_path / "t.csv")
    head, row = (tmp_path / "t.csv").read_text().splitlines()
    cells = dict(zip(head.split(","), row.split(","), strict=True)) | {"azimuth_deg": "400"}
    (tmp_path / "t.csv").write_text(f"{','.join(cells)}\n{','.join(cells.values())}\n")
    with pytest.raises(InputError, match=r"/t\.csv: row 1: view: azimuth_deg is 400"):
        gr.read_track(tmp_path / "t.csv")


@pytest.mark.parametrize("count", [1, 2])
def test_a_table_without_usable_times_names_its_file(tmp_path, count):
    names = [tmp_path / f"{k}.csv" for k in range(count)]
    for name in names:
        name.write_text("time,x,y\n3.5,1,2\n")
    told = r"/0\.csv: table: no usable time" if count == 1 else r"/0\.csv and 1 more: table: no us"
    with pytest.raises(InputError, match=told):
        gr.convert(names, tmp_path / "out.parquet")


def test_a_place_is_named_once_and_the_kind_of_the_error_stays():
    for message in (["{}: wrong", "a.json"], ["wrong"]):
        with pytest.raises(CrsError, match=r"(?m)^a\.json: wrong$") as caught, placed("a.json"):
            raise CrsError(*message, hint="mend it")
        assert (caught.value.hint, caught.value.about) == ("mend it", "a.json")


def test_an_error_knows_what_it_is_about_whatever_becomes_of_it(tmp_path):
    path = tmp_path / "a, 2025-06-12T07:30Z.csv"
    for error in (InputError("{}: no rows", path), InputError("{}", Text("{}: no rows", path))):
        again = pickle.loads(pickle.dumps(error_in_site_words(error, "Europe/Berlin", tmp_path)))  # noqa: S301
        assert again.message == "a, 2025-06-12 09:30 UTC+02:00.csv: no rows"
        assert again.about == str(path)
    assert InputError("no rows in {}: {}", path, "none").about == ""


def test_a_message_that_goes_on_after_a_text_is_about_the_same():
    begin = Text("{}: time goes back", "R1.parquet")
    error = InputError("{} in row {}", begin, 3)
    assert error.about == "R1.parquet"
    assert error.message.without("R1.parquet") == "time goes back in row 3"
    both = Text("; ").join([begin, Text("{}: no rows", "R2.parquet")])
    assert (both.about, both.without("R1.parquet")[:14]) == ("R1.parquet", "time goes back")


@pytest.mark.parametrize("text", ["{}", "{}: wrong", "{} is wrong"])
def test_a_text_without_values_is_about_nothing(text):
    """As a program of somebody else may say it."""
    error = InputError(text)
    assert (error.message, error.about) == (text, "")
    assert error.message.without("") is error.message


@pytest.mark.parametrize(("column", "value"), [("x", 1e9), ("z", float("nan")), ("time", 0.0)])
def test_an_error_of_a_row_is_about_its_recording(tmp_path, column, value):
    """By it a run leaves out the sensor, and goes on with the others."""
    rows = pd.read_parquet(gr.sample_folder() / "R1.parquet").head(500).reset_index(drop=True)
    rows.loc[300, column] = value
    rows.to_parquet(path := tmp_path / "R1.parquet")
    with pytest.raises(InputError, match="in row 301") as caught:
        list(open_recording(path).read())
    assert files_of(caught.value, [tmp_path / "R2.parquet", path]) == [path]


def test_a_traceback_ends_with_what_to_do():
    def last_lines(error):
        return traceback.format_exception(error)[-2:]

    wrong = InputError("a.json: wrong", hint="mend it")
    assert last_lines(wrong) == ["gis_radar.base.errors.InputError: a.json: wrong\n", "mend it\n"]
    wrong.hint = "mend a.json"  # in the words of who calls
    assert last_lines(wrong)[1] == "mend a.json\n"
    assert last_lines(InputError("wrong")) == ["gis_radar.base.errors.InputError: wrong\n"]
