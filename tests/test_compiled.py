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
