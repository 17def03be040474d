"""Markdown tables of what the bench measured, from its JSON alone."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Report = Mapping[str, Any]

OCCUPANCY = {
    "tiles": "d", "true_mean": ".1%", "answered": ".0%", "rank": ".2f", "scale": ".2f",
    "mae_percent": ".2f", "r2": ".2f", "false_zeros": ".0%", "false_busy": ".0%", "beyond": ".0%",
    "within_2_se": ".0%",
}  # fmt: skip
VEHICLES = {
    "recall": ".0%", "precision": ".0%", "found": ".0%", "real": ".0%", "gospa_m": ".1f",
    "hota": ".2f", "det_a": ".2f", "ass_a": ".2f", "along_m": ".2f", "across_m": ".2f",
    "speed_mps": ".2f", "speed_90_mps": ".2f", "length_m": ".2f", "length_bias_m": "+.2f",
    "two_groups": ".0%",
}  # fmt: skip
PASSAGES = {
    "passages": "d", "count_bias": "+.1%", "count_error": ".1%", "passages_recall": ".0%",
    "passages_precision": ".0%",
}  # fmt: skip
STEPS = {
    "missed_in_view": ".1%", "missed_hidden": ".1%", "misplaced": ".1%", "false_in_view": ".1%",
    "false_hidden": ".1%",
}  # fmt: skip
CAUSES = {
    "double": ".1%", "person": ".1%", "parked": ".1%", "ghost": ".1%",
    "missed_while_hidden": ".1%", "missed_no_data": ".1%", "missed_with_data": ".1%",
}  # fmt: skip
COSTS = {
    "sensor_minutes": ".1f", "cpu_s": ".2f", "occupancy_cpu_s": ".2f", "times_occupancy": ".1f",
    "peak_mb": ".0f", "occupancy_peak_mb": ".0f",
}  # fmt: skip
PARTS = {
    "occupancy": OCCUPANCY, "vehicles": VEHICLES, "passages": PASSAGES, "steps": STEPS,
    "causes": CAUSES, "costs": COSTS,
}  # fmt: skip
TARGETS = {
    "town": ">= .95 / .95-1.05 / <= 2 %",
    "harsh": ".92 / .93-1.07 / 3 %",
    "gridlock": ".85 / .93-1.07 / 7 %",
    "wide": ".96 / .93-1.07 / 1 %",
    "wide-light": ".95 / .93-1.07 / 0.4 %",
    "light": ".95 / .93-1.07 / 0.4 %",
}
READERS = {
    "hits": "hits",
    "DBSCAN + Kalman + Hungarian (Stone Soup)": "Stone Soup",
    "vehicles, true poses": "`vehicles`, true poses",
    "vehicles, found poses": "`vehicles`, found poses",
    "oracle association": "best possible",
}

NOTHING, SECOND = "nothing", "second sensor"
NOTHING_FIRST = "nothing, where the first sensor sees"
CHANGES = {
    "rank / scale / mean error, without": {
        ("occupancy", "rank"): ".2f", ("occupancy", "scale"): ".2f",
        ("occupancy", "mae_percent"): ".2f",
    },
    "recall / precision / passages off, without": {
        ("vehicles", "recall"): ".0%", ("vehicles", "precision"): ".0%",
        ("passages", "count_error"): ".0%",
    },
}  # fmt: skip


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def shown(value: object, form: str) -> str:
    """Return a figure as text; a dash where there is none."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "-"
    return format(value, form)


def part_table(rows: Mapping[str, Report], part: str) -> str:
    """Return the table of a part of the figures, for the rows that have it."""
    forms = PARTS[part]
    there = {name: row[part] for name, row in rows.items() if part in row}
    return table(
        ["what", *forms],
        ([name, *(shown(row.get(key), form) for key, form in forms.items())]
         for name, row in there.items()),
    )  # fmt: skip


def group_table(rows: Mapping[str, Report]) -> str:
    """Return rank / scale / error of each group of tiles."""
    there = {name: row["by_tiles"] for name, row in rows.items() if "by_tiles" in row}
    heads = list(next(iter(there.values()), {}))
    return table(
        ["rank / scale / MAE % / within 2 se", *heads],
        ([name, *(_cell(row[head], se=True) for head in heads)] for name, row in there.items()),
    )


def vehicle_group_table(rows: Mapping[str, Report]) -> str:
    """Return recall and precision of each group of vehicles."""
    there = {name: row["by_vehicles"] for name, row in rows.items() if "by_vehicles" in row}
    heads = list(next(iter(there.values()), {}))
    return table(
        ["what", *heads],
        ([name, *(shown(row.get(head), ".0%") for head in heads)] for name, row in there.items()),
    )


def _cell(figures: Mapping[str, float], *, se: bool = False) -> str:
    parts = [shown(figures.get(n), f) for n, f in (("rank", ".2f"), ("scale", ".2f"))]
    parts.append(shown(figures.get("mae_percent"), ".1f"))
    if se:
        parts.append(shown(figures.get("within_2_se"), ".0%"))
    return " / ".join(parts)


def everything(rows: Mapping[str, Report]) -> str:
    """Return all tables of some rows."""
    made = [part_table(rows, part) for part in PARTS if any(part in r for r in rows.values())]
    for kind, make in (("by_tiles", group_table), ("by_vehicles", vehicle_group_table)):
        if any(kind in row for row in rows.values()):
            made.append(make(rows))
    return "\n\n".join(made)


def readme(report: Report) -> str:
    """Return the tables of docs/accuracy.md from the bench's JSON: occupancy, then vehicles."""
    scenes: Mapping[str, Report] = report.get("scenes", {})
    names = {m: h for m, h in READERS.items() if any(m in rows for rows in scenes.values())}
    first = table(
        ["rank / scale / mean error, % of the time", "true mean", *names.values(), "target"],
        (
            [name, shown(_mean(rows), ".1%"),
             *(_cell(rows.get(method, {}).get("occupancy", {})) for method in names),
             TARGETS.get(name.removesuffix("-held"), "")]
            for name, rows in scenes.items()
        ),
    )  # fmt: skip
    own = {name: rows.get("vehicles, found poses", {}) for name, rows in scenes.items()}
    own = {name: row for name, row in own.items() if "vehicles" in row}
    if not own:
        return first
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
        ["`vehicles`, found poses", "poses off by, m", *(head for head, _ in heads.values())],
        (
            [name, _poses(row.get("pose_errors", {})), *(shown(row.get(part, {}).get(key), form)
                     for (part, key), (_, form) in heads.items())]
            for name, row in own.items()
        ),
    )  # fmt: skip
    return f"{first}\n\n{second}"


def _poses(errors: Mapping[str, Sequence[float]]) -> str:
    """Return how far the poses are off; a sensor whose pose cannot be found is surveyed."""
    return ", ".join(f"{apart:.2f}" if apart else "surveyed" for apart, _ in errors.values())


def _mean(rows: Mapping[str, Report]) -> object:
    found = (row["occupancy"]["true_mean"] for row in rows.values() if "occupancy" in row)
    return next(found, None)


def ablation(report: Report) -> str:
    """Return what each component of the tracker is worth: how figures change without it.

    Two tables, a row a component and a column a scene: occupancy, vehicles. A dash where nothing
    changes.
    """
    scenes: Mapping[str, Report] = report.get("ablation", {})
    names = dict.fromkeys(name for rows in scenes.values() for name in rows)
    return "\n\n".join(
        table(
            [what, *scenes],
            (
                [name, *(_change(rows, name, forms) for rows in scenes.values())]
                for name in names
                if name != NOTHING_FIRST
            ),
        )
        for what, forms in CHANGES.items()
    )


def _change(rows: Report, name: str, forms: Mapping[tuple[str, str], str]) -> str:
    """Return how figures change without a component; of the whole the figures."""
    figures = rows.get(name)
    if figures is None:
        return ""
    base = rows[NOTHING_FIRST if name == SECOND else NOTHING]
    values = [figures[part].get(key) for part, key in forms]
    if name == NOTHING:
        return " / ".join(map(shown, values, forms.values()))
    whole = [base[part].get(key) for part, key in forms]
    pairs = list(zip(values, whole, strict=True))
    if all(one == other for one, other in pairs):
        return "-"
    more = [None if None in pair else pair[0] - pair[1] for pair in pairs]
    return " / ".join(shown(x, f"+{form}") for x, form in zip(more, forms.values(), strict=True))


def bad_input(report: Report) -> str:
    """Return how the package behaves on bad input."""
    rows = report.get("bad input", {})
    return table(
        ["input", "exit", "as it should be", "false over 10 s", "doubled", "what was said"],
        (
            [name, str(row["code"]), "yes" if row["good"] else "NO", str(row["false"]),
             str(row.get("doubled", "-")), re.sub(r"/\S*/", "", str(row["said"])).replace("|", "/")]
            for name, row in rows.items()
        ),
    )  # fmt: skip
