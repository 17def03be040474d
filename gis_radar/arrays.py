"""Names for the arrays that travel between modules, and compiled inner loops."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, update_wrapper
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.int64]
Booleans: TypeAlias = NDArray[np.bool_]


def ranges(first: Integers, count: Integers) -> Integers:
    """Return so many whole numbers from each of `first` on, one range after the other."""
    return np.arange(count.sum()) + np.repeat(first + count - np.cumsum(count), count)


Given = ParamSpec("Given")
Answer = TypeVar("Answer")


def compiled(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Return a function of numbers and arrays that numba compiles at its first call.

    Numba itself is imported then, too: it takes longer than all the modules that use it. The
    function may call other compiled functions of its module by their names.

    The machine code is kept beside the module or in the user's cache; where neither can be
    written (a shared installation, a service without a home), each process compiles anew.
    """
    return _Compiled(function)


class _Compiled(Generic[Given, Answer]):
    """A function that becomes machine code at its first call."""

    def __init__(self, function: Callable[Given, Answer]) -> None:
        self.function = cast("FunctionType", function)
        update_wrapper(self, function)

    def __call__(self, *args: Given.args, **options: Given.kwargs) -> Answer:
        return cast("Answer", self.machine_code(*args, **options))

    @cached_property
    def machine_code(self) -> Any:
        """Dispatcher of numba."""
        import numba  # noqa: PLC0415 - 0.3 s

        plain = self.function
        # Numba calls what it made itself, so names of other compiled functions stand for that.
        names = {
            name: value.machine_code
            for name in plain.__code__.co_names
            if isinstance(value := plain.__globals__.get(name), _Compiled)
        }
        if names:
            plain = FunctionType(plain.__code__, {**plain.__globals__, **names}, plain.__name__)
        try:
            return numba.njit(cache=True, nogil=True)(plain)
        except RuntimeError:
            return numba.njit(nogil=True)(plain)
