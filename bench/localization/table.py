"""The table: errors in the town's sets DY and DO beside those of the paper's Table I."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from town import MASTS, SETS
from trials import COMPASS_DEG, METHODS, Result, Trial, spread

SENSORS = tuple(mast.sensor for mast in MASTS)
KINDS = ("near", "any")
MEANING = {
    "near": "within 10 m, heading as one of eight compass words",
    "any": "within 10 m, no heading",
}
NEAR_STARTS = {"lane": 50, "icp": 50}
# ICP must try eight headings, a start takes it as long as five of ours
ANY_STARTS = {"lane": 10, "icp": 2}
QUICK_STARTS = 2


@dataclass(frozen=True, kw_only=True)
class Paper:
    """A row of figures from the paper; NaN where it gives none.

    Parameters
    ----------
    flat_mean, flat_median, height : float
        Errors in metres.
    roll, pitch, yaw : float
        In degrees.
    """

    flat_mean: float
    flat_median: float = float("nan")
    height: float = float("nan")
    roll: float = float("nan")
    pitch: float = float("nan")
    yaw: float = float("nan")


# From its Table I, the distances of DY from X and Y; the real site from the text of section IV.A.
PAPER = {
    "DY": Paper(flat_mean=0.75, flat_median=0.95, height=1.06, yaw=0.38),
    "DO": Paper(flat_mean=1.65, flat_median=0.55, roll=0.28, pitch=0.33, yaw=0.75),
    "real site": Paper(flat_mean=1.06, height=0.59),
}
PAPER_FLAT = {
    "DY": dict(zip(SENSORS, (0.98, 1.04, 0.91, 0.13, 0.27, 1.17), strict=True)),
    "DO": dict(zip(SENSORS, (0.50, 5.06, 0.59, 0.19, 0.20, 3.35), strict=True)),
}


def plan(folder: Path, *, most: int, methods: Sequence[str] = METHODS) -> list[Trial]:
    """Return the trials of the table, at most so many starts a sensor, set and method."""
    trials = []
    for kind, starts in (("near", NEAR_STARTS), ("any", ANY_STARTS)):
        for set_name in SETS:
            for method in methods:
                trials += spread(
                    folder,
                    [f"{set_name}_{sensor}" for sensor in SENSORS],
                    f"{kind} {set_name}",
                    method=method,
                    count=min(most, starts[method]),
                    seed=7,
                    heading_deg=COMPASS_DEG if kind == "near" else None,
                )
    return trials


def figures(results: Sequence[Result]) -> dict[str, Any]:
    """Return the figures of a group of results."""
    error = np.array([r.error for r in results if not r.refused]).reshape(-1, 6)
    flat = np.hypot(error[:, 0], error[:, 1])
    count = max(len(results), 1)

    def of(values: Any, how: Callable[..., Any]) -> float:
        return float(how(values)) if len(values) else float("nan")

    names = ("height", "roll", "pitch", "yaw")
    return {
        "starts": len(results),
        "flat_mean": of(flat, np.mean),
        "flat_median": of(flat, np.median),
        "flat_worst": of(flat, np.max),
        **{name: of(np.abs(error[:, k]), np.mean) for k, name in enumerate(names, start=2)},
        **{f"{n}_median": of(np.abs(error[:, k]), np.median) for k, n in enumerate(names, start=2)},
        "right": sum(r.right for r in results) / count,
        "refused": sum(r.refused for r in results) / count,
        "unfixed": sum(not r.refused and not r.observable for r in results) / count,
        "wrong": sum(r.wrong for r in results) / count,
        "seconds": of([r.seconds for r in results], np.median),
    }


def report(results: Sequence[Result]) -> dict[str, Any]:
    """Return figures by group and method, and by sensor."""
    groups: dict[str, Any] = {}
    for kind in KINDS:
        for set_name in SETS:
            for method in METHODS:
                mine = [
                    r for r in results
                    if r.trial.group == f"{kind} {set_name}" and r.trial.method == method
                ]  # fmt: skip
                sensors = {
                    sensor: figures([r for r in mine if r.trial.name.endswith(sensor)])
                    for sensor in SENSORS
                }
                groups[f"{kind} {set_name} {method}"] = {**figures(mine), "sensors": sensors}
    return groups


MEASURES = """\
Mean absolute errors of the answers, in m and degrees. *Right*: within 1 m and 1 degree of the
truth. *Wrong*: answered as if it were fixed, and not right."""
HEADS = (
    "2D mean", "2D median", "height", "roll", "pitch", "yaw", "right", "refused", "wrong", "CPU s",
)  # fmt: skip


def markdown(groups: dict[str, Any]) -> str:
    """Return both tables: set by set, and sensor by sensor."""
    lines = [
        MEASURES,
        "",
        f"| set | starts | method | {' | '.join(HEADS)} |",
        "|---" * (3 + len(HEADS)) + "|",
    ]
    for set_name, own in PAPER.items():
        cells = [own.flat_mean, own.flat_median, own.height, own.roll, own.pitch, own.yaw]
        theirs = " | ".join([*(_number(cell) for cell in cells), "", "", "", ""])
        lines.append(f"| {set_name} | its own | the paper | {theirs} |")
        for kind in KINDS if set_name in SETS else ():
            rows = [(method, groups[f"{kind} {set_name} {method}"]) for method in METHODS]
            lines += [row(set_name, kind, method, f) for method, f in rows if f["starts"]]
    lines += ["", *(f"*{kind}*: {meaning}." for kind, meaning in MEANING.items()), ""]
    return "\n".join([*lines, *_by_sensor(groups)])


def row(set_name: str, kind: str, method: str, f: dict[str, Any]) -> str:
    """Return a row of the table."""
    names = ("flat_mean", "flat_median", "height", "roll", "pitch", "yaw")
    shares = [f"{f[name]:.0%}" for name in ("right", "refused", "wrong")]
    cells = [*(_number(f[name]) for name in names), *shares, f"{f['seconds']:.1f}"]
    return f"| {set_name} | {kind} ({f['starts']}) | {method} | {' | '.join(cells)} |"


def _by_sensor(groups: dict[str, Any]) -> list[str]:
    lines = [
        "Median 2D error in m, sensor by sensor, from near starts (share of right answers):",
        "",
        f"| set | method | {' | '.join(SENSORS)} |",
        "|---" * (2 + len(SENSORS)) + "|",
    ]
    for set_name in SETS:
        theirs = " | ".join(f"{PAPER_FLAT[set_name][sensor]:.2f}" for sensor in SENSORS)
        lines.append(f"| {set_name} | the paper | {theirs} |")
        for method in METHODS:
            if not groups[f"near {set_name} {method}"]["starts"]:
                continue
            by_sensor = groups[f"near {set_name} {method}"]["sensors"]
            cells = [
                f"{_number(by_sensor[sensor]['flat_median'])} ({by_sensor[sensor]['right']:.0%})"
                for sensor in SENSORS
            ]
            lines.append(f"| {set_name} | {method} | {' | '.join(cells)} |")
    return lines


# The page's rows: what they are of, and where the figures are from
ABOUT = {
    "DY": "the paper, 6 radars, yaw differs (DY)",
    "DO": "the paper, 6 radars, oriented freely (DO)",
    "real site": "the paper, real site",
}
OF_METHOD = {"icp": "its method as we have it, our town", "lane": "ours, our town"}
OF_SITE = {
    "sample_maps": "ours, sample junction as recorded, 2 radars",
    "town02": "ours, town blocks, 3 radars",
    "town04": "ours, motorway interchange, 3 radars",
}


def readme(by_conditions: dict[str, dict[str, Any]], sites: dict[str, Any]) -> str:
    """Return the page's table: starts within 10 m and no heading, under each of some conditions."""
    heads = ("site", "starts", "2D mean, median", "height", "yaw", "roll, pitch", "right")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for set_name, own in PAPER.items():
        starts = "near" if set_name in SETS else ""
        lines.append(_readme_row(ABOUT[set_name], starts, vars(own)))
        for method in ("icp", "lane") if set_name in SETS else ():
            for conditions, groups in by_conditions.items():
                found = groups.get(f"any {set_name} {method}", {"starts": 0})
                if found["starts"]:
                    about = f"{OF_METHOD[method]}, {conditions}"
                    lines.append(_readme_row(about, str(found["starts"]), found))
    rows = [(OF_SITE.get(name, f"ours, {name}"), found) for name, found in sites.items()]
    return "\n".join([*lines, *(_readme_row(name, str(f["starts"]), f) for name, f in rows)])


def _readme_row(about: str, starts: str, f: dict[str, Any]) -> str:
    def of(unit: str, *names: str) -> str:
        values = [_number(f[name]) for name in names if not np.isnan(f[name])]
        return f"{', '.join(values)} {unit}" if values else ""

    right = ""
    if "right" in f:
        rest = {"refused": f["refused"], "wrong": f["wrong"]}
        others = [f"{share:.0%} {name}" for name, share in rest.items() if share > 0.0]
        right = ", ".join([f"{f['right']:.0%}", *others])
    cells = (of("m", "flat_mean", "flat_median"), of("m", "height"), of("deg", "yaw"),
             of("deg", "roll", "pitch"), right)  # fmt: skip
    return f"| {about} | {starts} | {' | '.join(cells)} |"


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.2f}"
