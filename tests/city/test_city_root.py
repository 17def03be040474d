"""A city's folder: which datasets it holds, and what is refused."""

import json
import shutil

import pytest
from datasets import HOUR, recordings_of, write_dataset
from maps import Listener

import gis_radar as gr


def test_sites_are_the_datasets_by_name(tmp_path):
    for name in ("west", "east"):
        write_dataset(tmp_path / f"site={name}", hours=[HOUR])
    (tmp_path / "site=empty").mkdir()
    (tmp_path / "results" / "west").mkdir(parents=True)
    city = gr.open_city(tmp_path)
    assert list(city.sites) == ["east", "west"]
    assert city.sites["west"].folder == tmp_path / "site=west"
    assert len(city.sites["west"].hours()) == 1
    assert repr(city) == f"City({str(tmp_path)!r}: east, west)"
    assert gr.open_city(city) is city


def test_what_is_no_city_is_refused(tmp_path):
    with pytest.raises(gr.InputError, match="is no folder"):
        gr.open_city(tmp_path / "missing")
    dataset = write_dataset(tmp_path / "dataset", hours=[HOUR])
    with pytest.raises(gr.InputError, match="is no city: has no dataset site=NAME/"):
        gr.open_city(dataset.folder)


def test_two_sites_with_one_name_are_refused(tmp_path):
    for name in ("Mitte", "mitte"):
        write_dataset(tmp_path / f"site={name}", hours=[HOUR])
    with pytest.raises(gr.InputError, match="two sites have one name: Mitte and mitte"):
        gr.open_city(tmp_path)


def test_a_dataset_of_a_newer_schema_is_named(tmp_path):
    for name in ("east", "west"):
        dataset = write_dataset(tmp_path / f"site={name}", hours=[HOUR])
    path = dataset.folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"schema": 99}))
    with pytest.raises(gr.InputError, match="site=west: has schema 99, newer than 1"):
        gr.open_city(tmp_path)


@pytest.mark.parametrize("name", ["*", "\u00fc\n", ".hidden", "a:b", "end.", 201 * "x"])
def test_names_that_no_city_file_can_state_are_refused(tmp_path, name):
    (tmp_path / f"site={name}").mkdir()
    (tmp_path / f"site={name}" / "dataset.json").touch()
    with pytest.raises(gr.InputError, match="is no name of a site"):
        gr.open_city(tmp_path)


def test_two_names_of_one_folder_are_refused(tmp_path):
    write_dataset(tmp_path / "site=east", hours=[HOUR])
    (tmp_path / "site=copy").symlink_to("site=east")
    with pytest.raises(gr.InputError, match="two sites are one folder: copy and east"):
        gr.open_city(tmp_path)


def test_copies_of_recordings_are_told(tmp_path):
    write_dataset(tmp_path / "site=east", hours=[HOUR], recordings=recordings_of(["R1", "R2"]))
    write_dataset(tmp_path / "site=west", hours=[HOUR])
    said = Listener()
    gr.open_city(tmp_path, reporter=said)
    assert said.lines == []
    shutil.copytree(tmp_path / "site=east", tmp_path / "site=copy")
    gr.open_city(tmp_path, reporter=said)
    (line,) = said.lines
    assert line.startswith("sites copy and east have the same recordings")
