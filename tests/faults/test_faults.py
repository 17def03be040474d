"""Input kinds x faults: one line and an exit code, or a right result; never a crash or a bomb.

`make test` runs a sample with a fixed seed, `make faults` all of it. A kind is a line in
`inputs.py`, a fault a line in `damage.py`, a case that was found is a line in FOUND.
"""

import os
import random
import shutil
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from faults.damage import faults_of
from faults.inputs import KINDS
from gis_radar.cli.console import UNFORESEEN

ALL = os.environ.get("GIS_RADAR_FAULTS") == "all"
SAMPLE = 20
CASES = [(kind, fault) for kind in KINDS for fault in faults_of(kind.path)]
CHOSEN = CASES if ALL else random.Random(16).sample(CASES, SAMPLE)  # noqa: S311 - a sample
LONGEST_LINE = 700

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of processes are Linux's")


def words_of(kind, folder):
    """Return the words of a command with its files in a folder."""
    verb, *words = kind.words.replace("{}", kind.path).split()
    ours = [each.startswith("out") or (folder / each).exists() for each in words]
    places = [str(folder / each) if here else each for each, here in zip(words, ours, strict=True)]
    return [verb, *places]


def complaint(answer, folder):
    """Return what is wrong with how a command ended, or nothing."""
    lines = [line for line in answer["err"].splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("gis-radar: ")]
    marks = ("Traceback", UNFORESEEN, "Warning:", "panicked", "not enough memory")
    left = [path.name for path in folder.rglob(".*.part")]
    wrong = [(answer["late"], "took too long")]
    wrong += [(answer["code"] not in {0, 2, 3, 4}, f"ended with {answer['code']}")]
    wrong += [(mark in answer["err"], f"printed {mark}") for mark in marks]
    wrong += [(left, f"left {left}")]
    if answer["code"]:
        wrong += [(lines[-1:] != errors, f"printed {len(errors)} errors in {len(lines)} lines")]
        wrong += [(_made(folder), "left a result beside an error")]
    for line in errors:
        wrong += [(len(line) > LONGEST_LINE, f"printed a line of {len(line)} letters")]
        wrong += [(not line.isprintable(), "printed what no terminal shows")]
    return next((text for is_so, text in wrong if is_so), "")


def _made(folder):
    """Return the files that a command made; a folder for them may be there."""
    return [path for path in folder.glob("out*") if path.is_file() or list(path.rglob("*"))]


def name_of(case):
    kind, fault = case
    return f"{kind.name}: {fault}"


def some(cases, count):
    """Return all cases, or for `make test` a fixed sample of so many."""
    return cases if ALL else random.Random(5).sample(cases, count)  # noqa: S311 - a sample


SOUND = {kind.words.replace("{}", kind.path): kind for kind in KINDS}  # each command once


@pytest.mark.parametrize("kind", some(list(SOUND.values()), 5), ids=lambda kind: kind.name)
def test_what_is_sound_is_read(runner, inputs, tmp_path, kind):
    folder = shutil.copytree(inputs, tmp_path / "case")
    answer = runner.run(folder, words_of(kind, folder))
    assert answer["code"] == 0, answer["err"]
    assert complaint(answer, folder) == ""


@pytest.mark.parametrize("case", CHOSEN, ids=name_of)
def test_faults(runner, inputs, tmp_path, case):
    kind, fault = case
    folder = shutil.copytree(inputs, tmp_path / "case")
    chance = np.random.default_rng(zlib.crc32(name_of(case).encode()))
    path = folder / kind.path
    path.write_bytes(faults_of(kind.path)[fault](path.read_bytes(), chance))
    answer = runner.run(folder, words_of(kind, folder))
    wrong = complaint(answer, folder)
    assert wrong == "", f"{wrong}: {answer['err'][-1500:]}"


LIMITS = {
    "full disk": {"file_bytes": 20_000},
    "fuller disk": {"file_bytes": 3_000},
    "16 open files": {"files": 16},
    "no temporary files": {"temporary": "/proc"},  # where nobody makes a file, root neither
    "little memory": {"more_bytes": 100 << 20},
}
WRITERS = {kind.words.split()[0] + Path(kind.words.split()[-1]).suffix: kind for kind in KINDS
           if "-o" in kind.words}  # fmt: skip


SCARCE = [(limit, verb) for limit in LIMITS for verb in WRITERS]
# One limit for each that writes, all limits in turn.
FEW_SCARCE = [(list(LIMITS)[k % len(LIMITS)], verb) for k, verb in enumerate(WRITERS)]
ODD_NAMES = ["a !", "%20%", "#1", "a?b", "ä ö", "a\nb", "'a\"", "a;b&c", "[a]*", "\\a"]
ODD = [(name, verb) for name in ODD_NAMES for verb in WRITERS]


@pytest.mark.parametrize(("limit", "verb"), SCARCE if ALL else FEW_SCARCE)
def test_no_room(runner, inputs, tmp_path, limit, verb):
    """A file that may not grow is a full disk to who writes it; root meets it, too."""
    folder = shutil.copytree(inputs, tmp_path / "case")
    answer = runner.run(folder, words_of(WRITERS[verb], folder), **LIMITS[limit])
    if "memory" in limit:  # here it may be so
        answer["err"] = answer["err"].replace("not enough memory", "not enough room")
    assert complaint(answer, folder) == "", answer["err"][-1500:]
    if "disk" in limit and answer["code"]:
        assert answer["code"] == 3
        assert "cannot be written" in answer["err"] or "too large" in answer["err"], answer["err"]
    if limit == "no temporary files" and answer["code"]:
        assert answer["code"] == 3
        assert "/proc: cannot be written" in answer["err"], answer["err"]


@pytest.mark.parametrize(
    ("mebibytes", "verb"), [(1, "project.laz"), (1, "heatmap"), (30, "heatmap")]
)
def test_hardly_any_memory(runner, inputs, tmp_path, mebibytes, verb):
    """Where GDAL would abort, or a writer wait for ever: refused before the work."""
    folder = shutil.copytree(inputs, tmp_path / "case")
    limits = {"more_bytes": mebibytes << 20, "seconds": 120.0}
    answer = runner.run(folder, words_of(WRITERS[verb], folder), **limits)
    assert (answer["code"], answer["late"]) == (3, False)
    assert answer["err"].startswith("gis-radar: there is not enough memory (")
    assert answer["err"].count("\n") == 1


@pytest.mark.parametrize("mebibytes", [185, 206, 207])
def test_little_memory_leaves_no_dataset_beside_an_error(runner, inputs, tmp_path, mebibytes):
    """It ended while hours were made, or when lanes were read again for their names."""
    folder = shutil.copytree(inputs, tmp_path / "case")
    answer = runner.run(folder, words_of(WRITERS["measure"], folder), more_bytes=mebibytes << 20)
    assert answer["code"] <= 0 or not _made(folder), answer["err"]  # under 0: libraries ended it


@pytest.mark.parametrize(("name", "verb"), some(ODD, 5))
def test_odd_names(runner, inputs, tmp_path, name, verb):
    """Signs that mean something to a shell, to GDAL, to SQLite or in an address."""
    folder = shutil.copytree(inputs, tmp_path / name)
    answer = runner.run(folder, words_of(WRITERS[verb], folder))
    assert complaint(answer, folder) == "", answer["err"][-1500:]
    if name == "a !" and answer["code"]:  # GDAL's for a file in an archive
        assert "stands for a file in an archive" in answer["err"]
        return
    assert answer["code"] == 0 or "\n" in name, answer["err"]  # GDAL writes no such names
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]


@pytest.mark.parametrize("verb", some(list(WRITERS), 2))
def test_a_place_where_nobody_writes(runner, inputs, tmp_path, verb):
    folder = shutil.copytree(inputs, tmp_path / "case")
    words = words_of(WRITERS[verb], folder)
    place = words.index("-o") + 1
    words[place] = f"/proc/{Path(words[place]).name}"
    answer = runner.run(folder, words)
    assert answer["code"] == 3
    assert complaint(answer, folder) == ""
    assert f"{words[place]}: cannot be written" in answer["err"], answer["err"]
