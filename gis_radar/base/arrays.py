"""Types of arrays that modules share, and functions that numba compiles."""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, update_wrapper
from pathlib import Path
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.int64]
Booleans: TypeAlias = NDArray[np.bool_]


def ranges(first: Integers, count: Integers) -> Integers:
    """Return the integers of several ranges, each given by its first value and its length."""
    return np.arange(count.sum()) + np.repeat(first + count - np.cumsum(count), count)


def quotient(part: Any, whole: Any) -> Floats:
    """Return quotients, NaN where the divisor is not positive."""
    quotients: Floats = np.full(len(whole), np.nan)
    np.divide(part, whole, out=quotients, where=whole > 0)
    return quotients


def nearest(known: Floats, wanted: Floats) -> Integers:
    """Return the index of the nearest element of `known`, which is non-empty and unsorted."""
    order = np.argsort(known, kind="stable")
    later = np.clip(np.searchsorted(known[order], wanted), 0, len(known) - 1)
    earlier = np.maximum(later - 1, 0)
    is_earlier = np.abs(wanted - known[order[earlier]]) <= np.abs(known[order[later]] - wanted)
    return np.asarray(order[np.where(is_earlier, earlier, later)])


def contiguous(values: Any) -> Any:
    """Return an array C-contiguous and read-only: numba compiles anew for any other layout."""
    values = np.ascontiguousarray(values).view()
    values.flags.writeable = False
    return values


# Option of glibc's `mallopt`: least size of arrays with memory of their own; by default it grows
# with those that were freed, up to 32 MiB.
_M_MMAP_THRESHOLD, _LARGE_BYTES = -3, 4 << 20


def give_back_memory() -> None:
    """Give freed memory that the C library (glibc) keeps back to the system.

    Glibc keeps it in pieces between arrays in use: where large arrays come and go, a process grows
    to twice what they need. From the first call on, large arrays are given back as they are freed.
    """
    with suppress(OSError, AttributeError, TypeError):  # other systems have no such functions
        c_library = ctypes.CDLL(None)
        c_library.mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        c_library.malloc_trim(0)


Params = ParamSpec("Params")
Result = TypeVar("Result")


def compiled(function: Callable[Params, Result]) -> Callable[Params, Result]:
    """Return a function of numbers and arrays that numba compiles at its first call.

    Numba itself is imported then, too: it takes longer than all the modules that use it. The
    function may call other compiled functions, of its module or others, by their names.

    The machine code is kept beside the module or in the user's cache until the source of the
    function, or of one that it calls, changes; where neither can be written (a shared
    installation, a service without a home), each process compiles anew. Of several processes that
    call it first at the same time one compiles, and the others wait for that.
    """
    return _Compiled(function)


_COMPILES_S = 120.0  # longer than any of them takes to compile


class _Compiled(Generic[Params, Result]):
    """A function that becomes machine code at its first call."""

    def __init__(self, function: Callable[Params, Result]) -> None:
        self.function = cast("FunctionType", function)
        self._is_begun = False
        update_wrapper(self, function)

    def __call__(self, *args: Params.args, **options: Params.kwargs) -> Result:
        if not self._is_begun:
            if len(args) == self.function.__code__.co_argcount:
                self._compile_once(args)
            self._is_begun = True
        return cast("Result", self.machine_code(*args, **options))

    @cached_property
    def machine_code(self) -> Any:
        """Numba's dispatcher for the function."""
        import numba  # noqa: PLC0415 - 0.3 s

        # Compiled code calls dispatchers only: they stand for the other functions in its globals.
        names = {name: called.machine_code for name, called in self._compiled_calls.items()}
        globals_ = {**self.function.__globals__, **names}
        plain = FunctionType(self.function.__code__, globals_, self.function.__name__)
        # Numba's cache looks at the name and the date of one file: the name covers all the others.
        plain.__qualname__ = f"{self.function.__qualname__}_{self._sources_digest()}"
        options: dict[str, Any] = {"nogil": True, "no_cfunc_wrapper": True}  # no caller is C code
        try:
            return numba.njit(cache=True, **options)(plain)
        except RuntimeError:
            return numba.njit(**options)(plain)

    def _compile_once(self, given: tuple[Any, ...]) -> None:
        """Compile for arguments of these types, or load what another process compiles just now."""
        from filelock import FileLock, Timeout  # noqa: PLC0415 - as numba

        machine_code = self.machine_code
        place = machine_code.stats.cache_path if hasattr(machine_code, "stats") else None
        if place is None:  # no folder for machine code, or compiling is switched off
            return
        lock = FileLock(Path(place) / f"{self.function.__name__}.lock")
        try:
            lock.acquire(timeout=_COMPILES_S)
        except (OSError, NotImplementedError, Timeout):  # without a lock, each process compiles
            return
        try:
            machine_code.compile(tuple(machine_code.typeof_pyval(each) for each in given))
        finally:
            lock.release()

    @property
    def _globals_used(self) -> dict[str, Any]:
        """Global objects that the function uses, by name."""
        of = self.function.__globals__
        return {name: of[name] for name in self.function.__code__.co_names if name in of}

    @property
    def _compiled_calls(self) -> dict[str, _Compiled[Any, Any]]:
        """Compiled functions that this one calls, by the name it uses."""
        return {name: it for name, it in self._globals_used.items() if isinstance(it, _Compiled)}

    def sources(self) -> set[str]:
        """Return the sources and constants of this function and of all compiled ones it calls."""
        constants = {
            repr(it) for it in self._globals_used.items() if isinstance(it[1], int | float)
        }
        called = (each.sources() for each in self._compiled_calls.values())
        return {Path(self.function.__code__.co_filename).read_text("utf-8")}.union(
            constants, *called
        )

    def _sources_digest(self) -> str:
        """Return a digest of :meth:`sources`: code and constants may come from other modules."""
        return hashlib.sha256("".join(sorted(self.sources())).encode()).hexdigest()[:16]


@compiled
def heading_difference(to: float, since: float) -> float:  # pragma: no cover - compiled
    """Return the turn from heading `since` to heading `to`, radians in [-pi, pi)."""
    return (to - since + np.pi) % (2.0 * np.pi) - np.pi
