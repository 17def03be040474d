"""Stated probability of existence (`p_exists`) beside the true share, in classes of it.

    python bench/vehicles/existence.py --scene town,harsh,town02

With true poses. A vehicle is true in the share of its due time (`tracks.py`) in which it is matched
with a true vehicle: each half second by the assignment with the largest sum of overlaps.
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
from scipy.optimize import linear_sum_assignment
from tracks import by_step, compared, similarity

BIN_EDGES = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)


def stated_and_true(site: SceneFiles) -> pd.DataFrame:
    """Return `scene stated true` of each vehicle; those that are never due are left out."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = measured(site, Path(folder) / "dataset", found=False)
        states, vehicles = estimated_states(dataset), dataset.vehicles()
    scored = compared(site.tiles(), site.truth(), site.traffic(), states)
    real = np.zeros(len(scored.given), np.bool_)
    for one, other in by_step(scored):
        overlap = similarity(one, other)
        row, column = linear_sum_assignment(-overlap)
        real[other.index[column[overlap[row, column] > 0.0]]] = True
    due = scored.given.assign(true=real)[scored.given["due"]]
    table = due.groupby("vehicle")["true"].mean().reset_index()
    stated = vehicles.set_index("vehicle")["p_exists"]
    return table.assign(stated=table["vehicle"].map(stated), scene=site.name)


def main() -> None:
    """Print the table of all scenes together, and the means of each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", required=True)
    names = parser.parse_args().scene.split(",")
    table = pd.concat([stated_and_true(scene(name)) for name in names], ignore_index=True)
    part = table.groupby(pd.cut(table["stated"], BIN_EDGES), observed=True)
    print(part.agg(vehicles=("true", "size"), stated=("stated", "mean"), true=("true", "mean")))
    print(table.groupby("scene").agg(
        vehicles=("true", "size"), stated=("stated", "mean"), true=("true", "mean")
    ))  # fmt: skip


if __name__ == "__main__":
    main()
