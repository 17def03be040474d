import subprocess
import sys

import numba
import numpy as np

from gis_radar.base import compiled


def total(values):
    result = 0.0
    for value in values:
        result += value
    return result


@compiled
def mean(values):
    return fast_total(values) / len(values)


fast_total = compiled(total)


def test_a_loop_is_compiled():
    fast = compiled(total)
    assert fast(np.arange(5.0)) == 10.0
    assert len(fast.machine_code.signatures) == 1


def test_a_compiled_function_calls_another():
    assert mean(np.arange(5.0)) == 2.0
    assert len(mean.machine_code.signatures) == 1


def test_what_takes_long_to_import_waits_until_it_is_needed():
    code = (
        "import sys, gis_radar.calibration.single.localization, gis_radar.scans.mask\n"
        "assert 'numba' not in sys.modules\n"
        "import gis_radar.live.fusion, gis_radar.live.hours.hour_work\n"
        "assert 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_nowhere_to_keep_the_code_is_no_failure(monkeypatch):
    asked = []
    njit = numba.njit

    def without_place(**options):
        asked.append(options)
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", without_place)
    assert compiled(total)(np.arange(5.0)) == 10.0
    assert [bool(options.get("cache")) for options in asked] == [True, False]


HEAD = "from gis_radar.base.arrays import compiled\n"
OWN = "from called import plus, FACTOR\n@compiled\ndef own(x):\n    return plus(x) * FACTOR\n"
CALLED = "FACTOR = {}\n@compiled\ndef plus(x):\n    return x + {}\n"
ASK = (
    "import numba; from own import own; print('ready', flush=True); input()\n"
    "print(own(10), sum(own.machine_code.stats.cache_hits.values()))"
)


def asked(folder, *, at_once=1):
    """Return what processes say that call it at the same time: the answer, and if it was kept."""
    many = [
        subprocess.Popen([sys.executable, "-B", "-c", ASK], cwd=folder, text=True,
                         stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        for _ in range(at_once)
    ]  # fmt: skip
    for each in many:
        assert each.stdout.readline() == "ready\n"
    for each in many:
        each.stdin.write("\n")
        each.stdin.flush()
    return sorted(each.communicate()[0].split() for each in many)


def test_kept_code_is_made_once_and_anew_when_what_it_is_made_of_changes(tmp_path):
    (tmp_path / "own.py").write_text(HEAD + OWN)
    (tmp_path / "called.py").write_text(HEAD + CALLED.format(1, 1))
    assert asked(tmp_path, at_once=2) == [["11", "0"], ["11", "1"]]
    for factor, more, answer in ((1, 3, "13"), (2, 3, "26")):
        (tmp_path / "called.py").write_text(HEAD + CALLED.format(factor, more))
        assert asked(tmp_path) == [[answer, "0"]]
