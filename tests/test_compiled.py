import subprocess
import sys

import numba
import numpy as np

from gis_radar.arrays import compiled


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


def test_numba_is_not_imported_before_it_is_needed():
    rooms = "gis_radar.localization, gis_radar.scans.mask"
    code = f"import sys, {rooms}; assert 'numba' not in sys.modules"
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


HEAD = "from gis_radar.arrays import compiled\n"
OWN = "from called import plus, FACTOR\n@compiled\ndef own(x):\n    return plus(x) * FACTOR\n"
CALLED = "FACTOR = {}\n@compiled\ndef plus(x):\n    return x + {}\n"
ASK = "from own import own; print(own(10), sum(own.machine_code.stats.cache_hits.values()))"


def test_kept_code_is_made_anew_when_what_it_is_made_of_changes(tmp_path):
    (tmp_path / "own.py").write_text(HEAD + OWN)
    answers = []
    for factor, more in ((1, 1), (1, 1), (1, 3), (2, 3)):
        (tmp_path / "called.py").write_text(HEAD + CALLED.format(factor, more))
        asked = [sys.executable, "-B", "-c", ASK]
        answers.append(subprocess.check_output(asked, cwd=tmp_path, text=True).split())
    assert answers == [["11", "0"], ["11", "1"], ["13", "0"], ["26", "0"]]
