"""Arguments and keys that have another name now: the earlier one works on, with a warning."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def renamed(**names: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Let a function take arguments by their earlier names, too.

    Parameters
    ----------
    **names : str
        By earlier name: the name now.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        @wraps(function)
        def call(*given: P.args, **options: P.kwargs) -> T:
            every: dict[str, Any] = dict(options)
            for earlier in names.keys() & every.keys():
                now = names[earlier]
                if now in every:
                    raise TypeError(f"{function.__name__}() got both {now} and {earlier}")
                warn_of(f"{function.__name__}({earlier}=...)", f"{now}=", stacklevel=2)
                every[now] = every.pop(earlier)
            return function(*given, **every)

        return call

    return decorate


def warn_of(earlier: str, now: str, *, stacklevel: int) -> None:
    """Warn of an earlier name; the warning points to who used it, so many calls up."""
    text = f"{earlier} is an earlier name; use {now}"
    warnings.warn(text, DeprecationWarning, stacklevel=stacklevel + 1)
