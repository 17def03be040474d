"""A city's folder: which datasets it holds, and what is refused."""

import json

import pytest
from datasets import HOUR, write_dataset

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
