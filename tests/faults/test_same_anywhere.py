"""The sample's results on one thread and on two, its recordings in either order: the same bytes.

Minutes of work, which only `make faults` does.
"""

import os
import shutil
import subprocess
import sys

import pytest

import gis_radar as gr
from faults.conftest import ROOT
from faults.test_faults import ALL

SAMPLE = gr.sample_folder()
BOTH = "{0}.parquet {1}.parquet --pose {0}.json --pose {1}.json --tiles tiles.gpkg"
LANES = "--map junction.osm --road road.laz"
COMMANDS = [
    "mask scan.laz --map junction.osm --engine laspy -o made.laz",
    f"measure {BOTH} --map junction.osm --scan scan.laz -o made",
    f"measure {BOTH} --map junction.osm --hits-only -o made",
    "sight --pose {0}.json --pose {1}.json --tiles tiles.gpkg --scan scan.laz -o made.gpkg",
    f"clocks {BOTH} -o made.json",
    f"localize R1.parquet {LANES} --guess 690356,5336183 -o made.json",
    f"localize R1.parquet {LANES} --guess 690356,5336183 --scan scan.laz -o made.json",
    f"track R1.parquet {LANES} --pose R1.json -o made.csv",
    "run SITE.toml -o made",
]
CLOCKED = (".log", "state.json")  # they state when a run was, and of which files
pytestmark = pytest.mark.skipif(not ALL, reason="make faults")


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """The sample with road and tiles."""
    folder = shutil.copytree(SAMPLE, tmp_path_factory.mktemp("sample") / "sample")
    roads = gr.read_map(folder / "junction.osm")
    gr.mask_road([folder / "scan.laz"], roads, engine="laspy").write(folder / "road.laz")
    tiles = gr.make_tiles(roads)
    gr.write_tiles(tiles, folder / "tiles.gpkg", problems=roads.problems)
    return folder


def made(folder):
    paths = [path for top in folder.glob("made*") for path in (top, *top.rglob("*"))]
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in paths if path.is_file()
    }


@pytest.mark.parametrize("words", COMMANDS)
def test_threads_and_order_change_no_byte(sample, tmp_path, words):
    found = []
    for threads, order in ((1, ("R1", "R2")), (2, ("R2", "R1"))):
        folder = shutil.copytree(sample, tmp_path / "case")  # whose name is in recordings.parquet
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
        environment = os.environ | dict.fromkeys(names, str(threads)) | {"PYTHONPATH": str(ROOT)}
        line = [sys.executable, "-m", "gis_radar", *words.format(*order).split()]
        subprocess.run(line, cwd=folder, env=environment, check=True, capture_output=True)
        found.append(made(folder))
        shutil.rmtree(folder)
    one, other = found
    assert one
    assert sorted(one) == sorted(other)
    assert [key for key in one if one[key] != other[key] and not key.endswith(CLOCKED)] == []
