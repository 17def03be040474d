"""What each move, term and component of the search for vehicles earns: figures without it.

    python bench/vehicles/ablation.py --scene town-781,tee-783 --only as-is,no-cut

One row a part that is switched off, from the outside, with true poses. Detections are read once a
scene, and what the filter follows is found once, so that only what comes after it runs again; CPU
is that of what runs again. Rows are added to out/bench-vehicles/ablation.jsonl.
"""

# Parts are replaced in the modules that use them, where they are imported names.
# mypy: disable-error-code="attr-defined"
from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import ablated
import numpy as np
import own
import pandas as pd
from passages import score_passages
from scenes import MORE, OUT, SceneFiles, scene
from score import score_occupancy
from tracks import COLUMNS, compared, score_tracks

import gis_radar as gr
from gis_radar.dataset.hours import job as hour_job_module
from gis_radar.tracking import HourVehicles, tracker
from gis_radar.tracking import hour_vehicles as hour_vehicles_module

# what they import counts as theirs here
hour_job: Any = hour_job_module
hour_vehicles: Any = hour_vehicles_module
NEAR_M = 100.0  # of a sensor: volumes count there
ROWS = OUT / "ablation.jsonl"


@dataclass(kw_only=True)
class Kept:
    """What the search for vehicles of a scene is given, hour by hour, and what it found so far."""

    site: SceneFiles
    hours: list[tuple[Any, dict[str, Any]]] = field(default_factory=list)
    blocks: list[list[Any]] = field(default_factory=list)
    held: dict[str, list[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, site: SceneFiles) -> Kept:
        """Measure a scene once, and keep what goes into the search for vehicles."""
        kept = cls(site=site)
        vehicles_of_hour, blocks_of = hour_job.vehicles_of_hour, hour_vehicles.blocks_of

        def keep(*given: Any, **named: Any) -> Any:
            kept.hours.append((given, named))
            return vehicles_of_hour(*given, **named)

        def read(*given: Any) -> Iterator[Any]:
            kept.blocks.append(list(blocks_of(*given)))
            return iter(kept.blocks[-1])

        with (
            tempfile.TemporaryDirectory() as folder,
            patch.object(hour_job, "vehicles_of_hour", keep),
            patch.object(hour_vehicles, "blocks_of", read),
            patch.object(tracker, "vehicles_in", lambda *_: []),
            patch.object(hour_vehicles, "vehicles_in", lambda *_: []),
        ):
            gr.measure(
                site.recordings, site.poses, site.tiles(), site.map, Path(folder) / "dataset",
                scans=[site.scan],
            )  # fmt: skip
        return kept

    @contextmanager
    def remembered(self, name: str, under: str = "") -> Iterator[None]:
        """Let a function of the tracker answer as before, from its second run on."""
        function, held = getattr(tracker, name), self.held.setdefault(name + under, [])
        answers = iter(list(held))

        def answer(*given: Any) -> Any:
            found = next(answers, None)
            if found is None:
                found = function(*given)
                held.append(found)
            joined, states = found if isinstance(found, tuple) else (found, None)
            return (joined.copy(), states.copy()) if states is not None else list(joined)

        with patch.object(tracker, name, answer):
            yield

    def vehicles(self, off: str) -> tuple[list[HourVehicles], float]:
        """Return the vehicles of each hour without some parts, and CPU seconds."""
        parts = {name: ablated.PARTS[name] for name in off.split("+")}
        early = "+".join(name for name, part in parts.items() if not part.after_start)
        blocks = iter(self.blocks)
        with ExitStack() as stack:
            stack.enter_context(patch.object(hour_vehicles, "TRACK_EVERY_STEPS", 1))
            stack.enter_context(
                patch.object(hour_vehicles, "blocks_of", lambda *_: iter(next(blocks)))
            )
            stack.enter_context(self.remembered("_followed"))
            for change in (each for part in parts.values() for each in part.changes):
                stack.enter_context(change())
            stack.enter_context(self.remembered("_found", early))
            begin = time.process_time()
            found = [hour_vehicles.vehicles_of_hour(*a, **k) for a, k in self.hours]
            return found, time.process_time() - begin


def figures(site: SceneFiles, found: list[HourVehicles]) -> dict[str, float]:
    """Return the figures of a row."""
    tracks = pd.concat([each.tracks for each in found], ignore_index=True)
    length = pd.concat([each.vehicles for each in found]).set_index("vehicle")["length_m"]
    states = tracks.assign(
        length=tracks["vehicle"].map(length), heading=np.radians(tracks["heading"])
    )[list(COLUMNS)]
    occupied = pd.concat([each.occupied for each in found], ignore_index=True)
    visible = pd.concat([each.visible for each in found], ignore_index=True)
    score = score_occupancy(site.truth(), _occupancy(occupied, visible))
    scored = score_tracks(compared(site.tiles(), site.truth(), site.traffic(), states))
    given, true = pd.concat([each.passages for each in found]), site.passages()
    sight = site.lanelets_in_sight()
    every = score_passages(true, given[given["lanelet_id"].isin(sight)])
    near = lanelets_near(site, sight)
    volume = score_passages(
        true[true["lanelet_id"].isin(near)], given[given["lanelet_id"].isin(near)]
    )
    return {
        "volume_off": volume["count_error"], "volume_bias": volume["count_bias"],
        "passages": every["passages"], "passages_off": every["count_error"],
        "precision": scored["precision"], "recall": scored["recall"],
        "mae": score.mae_percent, "rank": score.rank,
    }  # fmt: skip


def lanelets_near(site: SceneFiles, among: Any) -> Any:
    """Return the lanelets whose middle is near a sensor."""
    tiles = site.tiles()
    half = (tiles.groupby("lanelet_id")["index"].transform("max") + 1) // 2
    middle = tiles[(tiles["index"] == half) & tiles["lanelet_id"].isin(among)]
    place = np.column_stack([middle.geometry.centroid.x, middle.geometry.centroid.y])
    eyes = np.array([pose.position[:2] for pose in site.poses])
    near = np.hypot(*np.moveaxis(place[:, None] - eyes, -1, 0)).min(axis=1) < NEAR_M
    return middle["lanelet_id"].to_numpy()[near]


def _occupancy(occupied: pd.DataFrame, visible: pd.DataFrame) -> pd.DataFrame:
    """Return `tile_id occupied_s visible_s`: what is occupied counts while visible."""
    ids = np.unique(visible["tile_id"])
    least = int(visible["first_step"].min())
    size = (len(ids), int(visible["last_step"].max()) - least + 1)
    flags = np.zeros((2, *size), np.bool_)
    for flag, runs in zip(flags, (occupied, visible), strict=True):
        for tile, first, last in runs[["tile_id", "first_step", "last_step"]].to_numpy().tolist():
            row = int(np.searchsorted(ids, tile))
            if row < len(ids) and ids[row] == tile and last >= least:
                flag[row, max(int(first) - least, 0) : int(last) - least + 1] = True
    both, seen = (flags[0] & flags[1]).sum(axis=1), flags[1].sum(axis=1)
    return pd.DataFrame({"tile_id": ids, "occupied_s": both * 0.05, "visible_s": seen * 0.05})


def main() -> None:
    """Run what is asked for; print a line a row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default=",".join([*list(MORE)[:6], "town02"]))
    parser.add_argument("--only", default=",".join(ablated.PARTS))
    options = parser.parse_args()
    for name in options.scene.split(","):
        site = scene(name)
        kept = Kept.of(site)
        kept.vehicles("as-is")  # compiled, and remembered
        for part in options.only.split(","):
            found, cpu_s = kept.vehicles(part)
            row = figures(site, found) | {"cpu_s": cpu_s / own.sensor_minutes(site)}
            print(name, part, *(f"{k}={v:.4g}" for k, v in row.items()), flush=True)
            with ROWS.open("a") as file:
                file.write(json.dumps({"scene": name, "part": part, **row}) + "\n")


if __name__ == "__main__":
    main()
