"""The same work gives the same bytes: every command twice, in folders of other names."""

import shutil
from dataclasses import replace

import laspy
import numpy as np
import pandas as pd
import pytest

import gis_radar as gr
from gis_radar.base import FILE_DATE
from gis_radar.products import write_projection

COMMANDS = [
    "tiles map.osm --road road.laz --streets streets.gpkg -o {}.gpkg",
    "mask scan.laz --engine laspy --map roads.gpkg -o {}.laz",
    *(f"project R1.parquet --pose R1.json -o {{}}.{kind}" for kind in ("gpkg", "laz", "parquet")),
    "sensors R1.json -o {}.gpkg",
    "convert bag -o {}.parquet",
    "measure R1.parquet --pose R1.json --tiles tiles.gpkg --map map.osm -o {}",
    "heatmap dataset --interval 1s -o {}",
    "report heatmap --dataset dataset -o {}",
    "qgis heatmap -o {}.qgz",
    "quality dataset -o {}.csv",
    "sight --pose R1.json --tiles tiles.gpkg --scan scan.laz -o {}.gpkg",
    "traffic dataset --interval 1min -o {}",
]  # fmt: skip


def files(folder):
    """What the outputs of commands hold, by name."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    made = {path.relative_to(folder).as_posix(): path for path in paths}
    return {
        name: path.read_bytes()
        for name, path in made.items()
        if name.startswith("made") and path.name != "recordings.parquet"  # names the folder
    }


@pytest.fixture(scope="module")
def places(sound_inputs, tmp_path_factory):
    """Two folders with the same inputs."""
    root = tmp_path_factory.mktemp("same")
    return [shutil.copytree(sound_inputs, root / name) for name in ("one", "the other")]


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: words.replace(" -o {}", ""))
def test_a_command_writes_the_same_bytes_twice(places, run, monkeypatch, words):
    made = []
    name = f"made{COMMANDS.index(words)}"
    for folder in places:
        monkeypatch.chdir(folder)
        code, _, error = run(*words.format(name).split())
        assert code == 0, error
        found = {key: data for key, data in files(folder).items() if key.startswith(name)}
        assert found
        made.append(found)
    one, other = made
    assert sorted(one) == sorted(other)
    assert [key for key in one if one[key] != other[key]] == []


def test_scans_are_of_one_day(places, tmp_path):
    """Two runs of one day would be the same all the same."""
    pose = gr.read_pose(places[0] / "R1.json")
    write_projection(places[0] / "R1.parquet", pose, tmp_path / "points.laz")
    for path in (tmp_path / "points.laz", places[0] / "road.laz"):
        with laspy.open(path) as reader:
            assert reader.header.creation_date == FILE_DATE, path


BOTH = "{0}.parquet {1}.parquet --pose {0}.json --pose {1}.json --tiles tiles.gpkg"


@pytest.mark.parametrize(
    "words",
    [
        f"measure {BOTH} --map map.osm -o made",
        "sight --pose {0}.json --pose {1}.json --tiles tiles.gpkg --scan scan.laz -o made.gpkg",
        "sensors {0}.json {1}.json -o made.gpkg",
    ],
)
def test_the_order_of_inputs_changes_no_byte(places, run, monkeypatch, tmp_path, words):
    made = []
    for order in (("R1", "R2"), ("R2", "R1")):
        folder = tmp_path / order[0]
        folder.mkdir()
        for name in ("R1.parquet", "R1.json", "tiles.gpkg", "map.osm", "scan.laz"):
            shutil.copy(places[0] / name, folder)
        seen = pd.read_parquet(folder / "R1.parquet")
        seen.assign(x=seen["x"] + np.float32(0.25)).to_parquet(folder / "R2.parquet")
        pose = gr.read_pose(folder / "R1.json")
        there = replace(pose, sensor="R2", northing=pose.northing + 2.0)
        there.write(folder / "R2.json")
        monkeypatch.chdir(folder)
        code, _, error = run(*words.format(*order).split())
        assert code == 0, error
        made.append(files(folder))
    one, other = made
    assert one
    assert [key for key in one if one[key] != other.get(key)] == []
