"""Markdown tables of the bench's figures, from its JSON."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1]))  # what all benches share
from figures import EXACT_CHANCE, Figure, table

Report = Mapping[str, Any]

# Figures that are printed by part, with their formats.
PARTS: Mapping[str, Mapping[str, str]] = {
    "occupancy": {
        "tiles": "d", "true_mean": ".1%", "answered": ".0%", "rank": ".2f", "scale": ".2f",
        "mae_percent": ".2f", "beyond": ".0%", "within_2_se": ".0%",
    },
    "vehicles": {
        "recall": ".0%", "precision": ".0%", "doubled": ".0%", "found": ".0%", "real": ".0%",
        "along_m": ".2f", "across_m": ".2f", "speed_mps": ".2f", "length_m": ".2f",
        "length_bias_m": "+.2f", "two_groups": ".0%",
    },
    "passages": {
        "passages": "d", "count_bias": "+.1%", "count_error": ".1%", "passages_recall": ".0%",
        "passages_precision": ".0%",
    },
    "costs": {"cpu_s": ".2f", "times_occupancy": ".1f", "peak_mib": ".0f"},
}  # fmt: skip
# Rank, scale and mean error of the occupancy that are aimed at, by scene.
TARGETS = {
    "town": ">= .95 / .95-1.05 / <= 2 %",
    "harsh": ".92 / .93-1.07 / 3 %",
    "gridlock": ".85 / .93-1.07 / 7 %",
    "wide": ".96 / .93-1.07 / 1 %",
    "wide-light": ".95 / .93-1.07 / 0.4 %",
    "light": ".95 / .93-1.07 / 0.4 %",
}
METHOD_TITLES = {
    "hits": "hits",
    "soup": "Stone Soup",
    "true": "`vehicles`, true poses",
    "found": "`vehicles`, found poses",
    "oracle": "best possible",
}


def shown(value: object, form: str) -> str:
    """Return a figure as text; a dash where there is none."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "-"
    return format(value, form)


def everything(rows: Mapping[str, Report]) -> str:
    """Return a table for each part of the figures, and one of occupancy by groups of tiles."""
    made = []
    for part, forms in PARTS.items():
        there = {name: row[part] for name, row in rows.items() if part in row}
        cells = [
            [name, *(shown(row.get(key), form) for key, form in forms.items())]
            for name, row in there.items()
        ]
        made += [table([part, *forms], cells)] if cells else []
    groups = {name: row["by_tiles"] for name, row in rows.items() if "by_tiles" in row}
    if groups:
        heads = list(next(iter(groups.values())))
        cells = [[name, *(_cell(row[head]) for head in heads)] for name, row in groups.items()]
        made.append(table(["rank / scale / mean error", *heads], cells))
    return "\n\n".join(made)


def _cell(figures: Report) -> str:
    """Return rank, scale and mean error as text."""
    names = {"rank": ".2f", "scale": ".2f", "mae_percent": ".1f"}
    return " / ".join(shown(figures.get(name), form) for name, form in names.items())


def accepted(report: Mapping[str, Report]) -> Iterator[Figure]:
    """Yield the figures of scenes, to compare with accepted ones."""
    for scene, methods in report.items():
        found = methods.get("found", {}).get("occupancy")
        peer = methods.get("soup", {}).get("occupancy", {})
        if found is None:
            continue
        yield Figure(
            what=f"occupancy, {scene}: rank", ours=found["rank"], peer=peer.get("rank"),
            peer_name="Stone Soup", more_is_better=True, chance=EXACT_CHANCE,
        )  # fmt: skip
        yield Figure(
            what=f"occupancy, {scene}: mean error", ours=found["mae_percent"], unit="% of the time",
            peer=peer.get("mae_percent"), peer_name="Stone Soup",
        )  # fmt: skip


def accuracy_tables(scenes: Mapping[str, Report]) -> str:
    """Return the tables of docs/accuracy.md: of occupancy, and of vehicles."""
    first = table(
        ["rank / scale / mean error, % of the time", "true mean", *METHOD_TITLES.values(),
         "target"],
        (
            [name, shown(_mean(rows), ".1%"),
             *(_cell(rows.get(method, {}).get("occupancy", {})) for method in METHOD_TITLES),
             TARGETS.get(name.removesuffix("-held"), "")]
            for name, rows in scenes.items()
        ),
    )  # fmt: skip
    heads = {
        ("vehicles", "recall"): ("recall", ".0%"),
        ("vehicles", "precision"): ("precision", ".0%"),
        ("passages", "count_error"): ("passages a lanelet, error", ".0%"),
        ("vehicles", "speed_mps"): ("speed, median error m/s", ".2f"),
        ("vehicles", "length_m"): ("length, median error m", ".2f"),
        ("occupancy", "within_2_se"): ("within 2 standard errors", ".0%"),
        ("costs", "cpu_s"): ("CPU s a sensor-minute", ".1f"),
        ("costs", "times_occupancy"): ("times decoding + hit share", ".1f"),
    }
    second = table(
        [METHOD_TITLES["found"], "poses off by, m", *(head for head, _ in heads.values())],
        (
            [name, _poses(row.get("pose_errors", {})), *(shown(row.get(part, {}).get(key), form)
                     for (part, key), (_, form) in heads.items())]
            for name, rows in scenes.items() if "vehicles" in (row := rows.get("found", {}))
        ),
    )  # fmt: skip
    return f"{first}\n\n{second}"


def _poses(errors: Mapping[str, Sequence[float]]) -> str:
    """Return the errors of poses on the plane as text; a pose without any was surveyed."""
    return ", ".join(f"{apart:.2f}" if apart else "surveyed" for apart, _ in errors.values())


def _mean(rows: Mapping[str, Report]) -> object:
    found = (row["occupancy"]["true_mean"] for row in rows.values() if "occupancy" in row)
    return next(found, None)
