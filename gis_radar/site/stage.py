"""A stage of a run as data: what it reads, what it is told, what it makes, who does it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gis_radar.errors import GisRadarError

State = Literal["done", "kept", "refused", "failed", "skipped"]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One step from files to files.

    Parameters
    ----------
    name : str
        Shown to the user, and the name of its record.
    work : str
        Which function of :mod:`gis_radar.site.work` does it.
    inputs : mapping
        Files and folders by the function's arguments; all are needed.
    parts : mapping
        The same, of which those count that are there: at least one a list.
    options : mapping
        The function's other arguments; what JSON can hold.
    outputs : tuple of Path
        What it makes, in the order in which the function takes them.
    phases : int
        How many bars its work would show by itself.
    sensor : str
        Whose it is: if it fails, other sensors go on. Empty where all depends on it.
    """

    name: str
    work: str
    inputs: Mapping[str, tuple[Path, ...]]
    outputs: tuple[Path, ...]
    parts: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    phases: int = 1
    sensor: str = ""

    @property
    def reads(self) -> tuple[Path, ...]:
        """All that it may read."""
        lists = (*self.inputs.values(), *self.parts.values())
        return tuple(path for paths in lists for path in paths)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a stage ended.

    Parameters
    ----------
    stage : Stage
        Which.
    state : str
        `done` now, `kept` from an earlier run, `refused` for want of a trustworthy answer, `failed`
        for bad data, `skipped` because what it needs is missing.
    figures : mapping
        What is worth a look.
    warnings : sequence of str
        What its work warned of.
    error : GisRadarError, optional
        Why there is no result.
    seconds : float
        How long it took, now or then.
    """

    stage: Stage
    state: State
    figures: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    error: GisRadarError | None = None
    seconds: float = 0.0

    @property
    def has_result(self) -> bool:
        """Whether its outputs are there."""
        return self.state in {"done", "kept"}
