"""Vehicles that are missed and false tracks: time by cause, and the longest cases.

    python bench/vehicles/worst.py --scene town-991,gridlock-934 [--poses found] [--dataset DATASET]

Within 100 m of a radar. A true vehicle is missed while no track is within 4 m of its middle, a
track is false while no vehicle is. The cause follows from the other side's bodies that overlap it:
a long vehicle is followed as a short one or as two, one track follows several vehicles, a vehicle
is followed twice, or nobody is there.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from found import estimated_states
from own import measured
from scenes import SceneFiles, scene
from targets import STANDS_MPS, near_only
from tracks import EVERY_STEPS, Scored, compared, matched

import gis_radar as gr
from gis_radar.base import STEP_S, Floats

LONG_M, SMALL_M = 7.0, 3.0  # lorries and buses are longer, motorcycles and bicycles shorter
ASIDE_M = 1.7  # bodies farther aside do not overlap
LISTED = 20  # cases that are printed
AS_SHORT = "a long one is followed as a short one"
AS_TWO, IN_PLACE = "a long one is followed as two", "a long one is followed in place of several"


def main() -> None:
    """Print the time by cause, and the longest cases."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", required=True)
    parser.add_argument("--poses", choices=("true", "found"), default="true")
    parser.add_argument("--dataset", type=Path, help="measured before; of a single scene")
    options = parser.parse_args()
    names = options.scene.split(",")
    if options.dataset and len(names) > 1:
        parser.error("--dataset is of one scene")
    sides = [_of_scene(scene(name), options.poses, options.dataset) for name in names]
    errors = pd.concat(sides, ignore_index=True)
    print(shares(errors).to_string(), "\n")
    worst = errors.sort_values("seconds", ascending=False).head(LISTED)
    print(worst.round(1).to_string(index=False))


def _of_scene(site: SceneFiles, poses: str, dataset: Path | None) -> pd.DataFrame:
    """Return the cases of a scene, which is measured where no dataset is given."""
    with tempfile.TemporaryDirectory() as folder:
        if dataset is None:
            opened = measured(site, Path(folder) / "dataset", found=poses == "found")
        else:
            opened = gr.open_dataset(dataset)
        states = estimated_states(opened)
    scored = near_only(site, compared(site.tiles(), site.truth(), site.traffic(), states))
    return errors_of(scored).assign(scene=site.name)


def errors_of(scored: Scored) -> pd.DataFrame:
    """Return a row a vehicle and cause: `side vehicle cause length seconds begin_s`.

    `side` is ``missed`` or ``false``; `begin_s` counts from the first step that is compared.
    """
    true, given = matched(scored)
    first = int(true["step"].min())
    parts = []
    for side, table, others in (("missed", true, given), ("false", given, true)):
        bad = table[table["due"] & (table["match"] < 0)]
        causes = _causes(side, bad, others)
        rows = bad.assign(cause=causes, side=side, begin_s=(bad["step"] - first) * STEP_S)
        groups = rows.groupby(["side", "vehicle", "cause"])
        parts.append(groups.agg(
            length=("length", "median"), seconds=("step", "size"), begin_s=("begin_s", "min")
        ).reset_index())  # fmt: skip
    found = pd.concat(parts, ignore_index=True)
    return found.assign(seconds=found["seconds"] * EVERY_STEPS * STEP_S)


def _causes(side: str, bad: pd.DataFrame, others: pd.DataFrame) -> list[str]:
    """Return the cause of each unmatched row, from the other side's bodies in the same step."""
    by_step = dict(tuple(others.groupby("step")))
    none = others.iloc[:0]
    return [
        _cause(side, row, on_body(row, by_step.get(row["step"], none))) for _, row in bad.iterrows()
    ]


def _cause(side: str, row: pd.Series, bodies: pd.DataFrame) -> str:
    """Return the cause of an unmatched row, from the other side's bodies that overlap it."""
    stands = "stands" if row["speed"] < STANDS_MPS else "drives"
    if bodies.empty:
        return _nobody(side, row, stands)
    is_long, long = row["length"] > LONG_M, bodies["length"] > LONG_M
    if side == "false" and (bodies["match"] >= 0).all():
        return AS_TWO if long.any() else "followed twice"
    true_is_long, track_is_long = (
        (is_long, long.any()) if side == "missed" else (long.any(), is_long)
    )
    track_is_short = (~long).any() if side == "missed" else not is_long
    if true_is_long and track_is_short:
        return AS_SHORT
    alone = true_is_long and len(bodies) == 1  # followed with its length, but too far away
    return IN_PLACE if track_is_long and not alone else f"off its place, {stands}"


def _nobody(side: str, row: pd.Series, stands: str) -> str:
    """Return the cause of a row that no body of the other side overlaps."""
    if side == "false":
        return f"nobody there, {stands}"
    small = ", motorcycle or bicycle" if row["length"] < SMALL_M else ""
    return f"not followed, {stands}{small}"


def on_body(row: pd.Series, others: pd.DataFrame) -> pd.DataFrame:
    """Return the bodies that overlap a row's."""
    cos, sin = np.cos(row["heading"]), np.sin(row["heading"])
    east, north = (others[c].to_numpy() - row[c] for c in ("easting", "northing"))
    along: Floats = np.abs(cos * east + sin * north)
    aside: Floats = np.abs(cos * north - sin * east)
    reach = 0.5 * (row["length"] + others["length"].to_numpy())
    near: pd.DataFrame = others[(along < reach) & (aside < ASIDE_M)]
    return near


def shares(errors: pd.DataFrame) -> pd.DataFrame:
    """Return seconds, number of vehicles and share by side and cause, the largest first."""
    sums = errors.groupby(["side", "cause"])["seconds"].agg(["sum", "size"])
    sums["share"] = sums["sum"] / sums.groupby("side")["sum"].transform("sum")
    sums = sums.sort_values(["side", "sum"], ascending=False)
    return sums.rename(columns={"sum": "seconds", "size": "vehicles"}).round(3)


if __name__ == "__main__":
    main()
