"""Tables of errors: by group of trials, and for docs/accuracy.md beside the paper's Table I."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from town import MASTS, SETS
from trials import COMPASS_DEG, COMPONENTS, Result, Trial, spread

sys.path.append(str(Path(__file__).resolve().parents[1]))  # what all benches share
from figures import EXACT_CHANCE, Figure
from figures import table as markdown_table

KINDS = ("near", "any")
# Starts a sensor. Without a heading ICP tries eight, which takes as long as five of our starts.
NEAR_STARTS = {"lane": 50, "icp": 50}
ANY_STARTS = {"lane": 10, "icp": 2}
LEAST_M, LEAST_DEG = 0.02, 0.02  # smaller differences from run to run are chance
WITHIN_SIGMAS = 2.0  # 95 % of errors should be
MEASURES = """\
Mean absolute errors of the answers, in m and degrees. *Near*: within 10 m, heading as one of eight
compass words; *any*: within 10 m, no heading. *Right*: within 1 m and 1 degree of the truth.
*Wrong*: answered as if it were fixed, and not right. *Within 2 sigma*: of the right answers,
easting, northing, height, roll, pitch, yaw."""
Figures = dict[str, Any]


def plan(folder: Path, *, most: int, methods: Sequence[str]) -> list[Trial]:
    """Return the trials of the town's sets, at most `most` starts a sensor, set and method."""
    trials = []
    for kind, starts in (("near", NEAR_STARTS), ("any", ANY_STARTS)):
        for set_name in SETS:
            for method in methods:
                trials += spread(
                    folder,
                    [f"{set_name}_{mast.sensor}" for mast in MASTS],
                    f"{kind} {set_name}",
                    method=method,
                    count=min(most, starts[method]),
                    seed=7,
                    heading_deg=COMPASS_DEG if kind == "near" else None,
                )
    return trials


def by_group(results: Iterable[Result]) -> dict[str, Figures]:
    """Return figures by group and method, such as ``near DY lane``."""
    groups: dict[str, list[Result]] = {}
    for each in results:
        groups.setdefault(f"{each.trial.group} {each.trial.method}", []).append(each)
    return {name: figures(group) for name, group in groups.items()}


def figures(results: Sequence[Result]) -> Figures:
    """Return mean and median errors, shares of outcomes and CPU time of a group of results."""
    error = np.array([r.error for r in results if not r.refused]).reshape(-1, 6)
    flat = np.hypot(error[:, 0], error[:, 1])
    right = [r for r in results if r.right and r.observable and r.sigma]
    ratio = np.array([np.divide(r.error, r.sigma) for r in right]).reshape(-1, 6)

    def of(values: Any, how: Callable[..., Any]) -> float:
        return float(how(values)) if len(values) else math.nan

    return {
        "starts": len(results),
        "flat_mean": of(flat, np.mean),
        "flat_median": of(flat, np.median),
        **{name: of(np.abs(error[:, k]), np.mean) for k, name in enumerate(COMPONENTS)},
        "right": sum(r.right for r in results) / len(results),
        "refused": sum(r.refused for r in results) / len(results),
        "unfixed": sum(not r.refused and not r.observable for r in results) / len(results),
        "wrong": sum(r.wrong for r in results) / len(results),
        "within": [of(np.abs(ratio[:, k]) < WITHIN_SIGMAS, np.mean) for k in range(6)],
        "nees_median": of([r.nees for r in right], np.median),
        "seconds": of([r.seconds for r in results], np.median),
    }


ERRORS = {
    "flat_mean": "2D mean", "flat_median": "2D median", "height": "height", "roll": "roll",
    "pitch": "pitch", "yaw": "yaw",
}  # fmt: skip
SHARES = ("right", "refused", "unfixed", "wrong")


def markdown(groups: Mapping[str, Figures]) -> str:
    """Return a Markdown table with a row a group."""
    rows = [
        [
            name, str(f["starts"]), *(_number(f[each]) for each in ERRORS),
            *(f"{f[each]:.0%}" for each in SHARES),
            ", ".join(f"{share:.0%}" for share in f["within"]),
            _number(f["nees_median"]), f"{f['seconds']:.1f}",
        ]
        for name, f in groups.items()
    ]  # fmt: skip
    heads = ["group", "starts", *ERRORS.values(), *SHARES, "within 2 sigma", "median NEES", "CPU s"]
    return f"{MEASURES}\n\n{markdown_table(heads, rows)}"


def accepted(groups: Mapping[str, Figures], conditions: str) -> Iterable[Figure]:
    """Yield the figures of our method on the town's sets, to compare with accepted ones."""
    for group, row in groups.items():
        if not group.endswith(" lane") or group.split()[0] not in KINDS:
            continue
        where = f"pose, {conditions}, {group.removesuffix(' lane')}"
        yield Figure(what=f"{where}: 2D mean", ours=row["flat_mean"], unit="m", least=LEAST_M)
        yield Figure(what=f"{where}: yaw mean", ours=row["yaw"], unit="deg", least=LEAST_DEG)
        yield Figure(
            what=f"{where}: right", ours=100.0 * row["right"], unit="%", more_is_better=True,
            chance=EXACT_CHANCE,
        )  # fmt: skip


# The paper's figures, m and degrees: of its Table I (distances of DY follow from its X and Y); of
# the real site from section IV.A.
PAPER: Mapping[str, Figures] = {
    "DY": {"flat_mean": 0.75, "flat_median": 0.95, "height": 1.06, "yaw": 0.38},
    "DO": {"flat_mean": 1.65, "flat_median": 0.55, "roll": 0.28, "pitch": 0.33, "yaw": 0.75},
    "real site": {"flat_mean": 1.06, "height": 0.59},
}
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


def accuracy_table(by_conditions: Mapping[str, Mapping[str, Figures]]) -> str:
    """Return the table of docs/accuracy.md: guesses within 10 m, no heading, by conditions."""
    rows = []
    for set_name, own in PAPER.items():
        rows.append(_accuracy_row(ABOUT[set_name], "near" if set_name in SETS else "", own))
        for method in ("icp", "lane") if set_name in SETS else ():
            for conditions, groups in by_conditions.items():
                if found := groups.get(f"any {set_name} {method}"):
                    about = f"{OF_METHOD[method]}, {conditions}"
                    rows.append(_accuracy_row(about, str(found["starts"]), found))
    rows += [
        _accuracy_row(about, str(found["starts"]), found)
        for name, about in OF_SITE.items()
        for groups in by_conditions.values()
        if (found := groups.get(f"site {name} lane"))
    ]
    rows += [
        _accuracy_row(f"ours, random places, {conditions}", str(found["starts"]), found)
        for conditions, groups in by_conditions.items()
        if (found := groups.get("random lane"))
    ]
    heads = ("site", "starts", "2D mean, median", "height", "yaw", "roll, pitch", "right")
    return markdown_table(heads, rows)


def _accuracy_row(about: str, starts: str, f: Figures) -> list[str]:
    """Return a row of that table."""

    def of(unit: str, *names: str) -> str:
        values = [_number(f[name]) for name in names if not math.isnan(f.get(name, math.nan))]
        return f"{', '.join(values)} {unit}" if values else ""

    right = ""
    if "right" in f:
        others = [f"{f[name]:.0%} {name}" for name in ("refused", "wrong") if f[name] > 0.0]
        right = ", ".join([f"{f['right']:.0%}", *others])
    errors = of("m", "flat_mean", "flat_median"), of("m", "height"), of("deg", "yaw")
    return [about, starts, *errors, of("deg", "roll", "pitch"), right]


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f}"
