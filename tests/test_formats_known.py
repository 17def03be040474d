"""Each format has what it claims: an input of its own, endings, and whether it opens directly."""

import re
from pathlib import Path

import pytest
from faults.inputs import KINDS
from test_formats_scenes import write_scene

import gis_radar as gr
from gis_radar.base import InputError
from gis_radar.recordings import format_of, is_recording, known_formats
from gis_radar.recordings.formats import direct_endings

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def inputs(sound_inputs, tmp_path_factory):
    """Give the sound inputs of `convert` by format, and those that open directly."""
    scene = tmp_path_factory.mktemp("scene")
    write_scene(scene)
    of = {"convert": [str(scene)], "project": []}
    for kind in KINDS:
        verb, given, *_ = kind.words.split()
        if verb == "convert" or (verb, given) == ("project", "{}"):
            of[verb].append(str(sound_inputs / given.format(kind.path)))
    return of


FOREIGN = [form for form in known_formats() if not form.live]


@pytest.mark.parametrize("form", FOREIGN, ids=lambda form: form.name)
def test_a_sound_input_is_converted(inputs, tmp_path, form):
    mine = [each for each in inputs["convert"] if format_of(each) is form]
    assert mine, "add a kind to tests/faults/inputs.py"
    for source in mine:
        assert gr.convert(source, tmp_path / "out.parquet").recordings[0].frames > 0
        if not form.opens:
            assert not is_recording(Path(source))
            with pytest.raises(InputError, match="not a known recording format"):
                gr.open_recording(source)


@pytest.mark.parametrize("ending", direct_endings())
def test_a_file_of_an_ending_that_opens_directly_does(inputs, ending):
    mine = [each for each in inputs["project"] if each.endswith(ending)]
    assert mine, "add a kind that `project` reads to tests/faults/inputs.py"
    for source in mine:
        assert is_recording(Path(source))
        assert sum(map(len, gr.open_recording(source).read())) > 0
        assert format_of(source).opens


def test_the_most_specific_is_asked_first():
    ranks = [form.rank for form in known_formats()]
    assert known_formats()[-1].name == "table"
    assert ranks[-2] < ranks[-1]


def test_pages_and_the_plugin_name_the_endings():
    formats = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    assert [e for form in known_formats() for e in form.endings if f"`{e}`" not in formats] == []
    told = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    assert f"(known endings: {', '.join(direct_endings())}; " in told
    code = "".join(p.read_text(encoding="utf-8") for p in ROOT.glob("qgis_plugin/gis*/**/*.py"))
    filters = re.findall(r"\n(?!.*Output\().*Recordings\W*?\((\*[^)]*)\)", code)
    assert len(filters) > 2
    for each in filters:
        assert {f"*{ending}" for ending in direct_endings()} == set(each.split())
