"""Sight against the truth of simulated places: towns with houses, and roads on two levels.

`wrongly seen` is the share of the tiles called in sight that are truly hidden, `lost` the share of
those truly in sight that are called hidden, `right` that of all tiles in view. Scans come with and
without classes, dense and thin. Exit code 1 outside the targets.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np

import gis_radar as gr
from gis_radar.arrays import Booleans
from gis_radar.sight import IN_SIGHT, OUT_OF_VIEW
from simulation.lanelet_writer import write_lanelets
from simulation.network import build_network, read_network
from simulation.roadside import Roadside, furnish
from simulation.scan import ScanModel, Strip, fly, write_scan
from simulation.sight import building_walls
from simulation.terrain import Terrain

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "bench" / "localization"))
import two_levels  # noqa: E402
from places import ORIGIN, UTM  # noqa: E402
from street_plans import NO_TURNS  # noqa: E402
from town import masts_of, town_plan  # noqa: E402

TOWNS, LEVELS = (4, 7), (1, 2, 3)
DENSE = (Strip(heading_deg=24.0, slant=0.16), Strip(heading_deg=208.0, slant=0.1))
SCANS = {"classes": (True, 1.0), "no classes": (False, 1.0), "thin, no classes": (False, 2.2)}
UP = np.array([0.0, 0.0, 0.6])  # to where a tile counts as seen
LIMITS = {"wrongly_seen": 0.02, "lost": 0.03}
LEAST_RIGHT, MOST_SECONDS = 0.95, 10.0
TERRAIN = Terrain(
    origin=ORIGIN, height_m=374.0, slope=(0.011, 0.017), wave_m=0.5, wave_length_m=310.0
)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What was found at a place, over all its sensors.

    Parameters
    ----------
    group, place : str
        Kind of scene and scan, and which place.
    called, true : (n,) bool arrays
        In sight as called and in truth, of the tiles in view.
    seconds : float
        For reading the scan and all sensors.
    """

    group: str
    place: str
    called: Booleans
    true: Booleans
    seconds: float

    def figures(self) -> dict[str, float]:
        """Return shares and time."""
        return {
            "tiles": float(len(self.true)),
            "in_sight": float(self.true.mean()),
            "wrongly_seen": float((~self.true[self.called]).mean()),
            "lost": float((~self.called[self.true]).mean()),
            "right": float((self.called == self.true).mean()),
            "seconds": self.seconds,
        }


def main() -> None:
    """Measure each place with each scan, print the table, keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--towns", type=int, nargs="*", default=TOWNS)
    parser.add_argument("--levels", type=int, nargs="*", default=LEVELS)
    parser.add_argument("--scans", nargs="*", choices=SCANS, default=tuple(SCANS))
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-sight.json")
    arguments = parser.parse_args()
    verdicts: list[Verdict] = []
    with tempfile.TemporaryDirectory() as folder:
        for number in arguments.towns:
            verdicts += town(number, arguments.scans, Path(folder))
        for number in arguments.levels:
            verdicts += levels(number, arguments.scans, Path(folder))
    heads = list(verdicts[0].figures())
    print(f"{'place':38s}" + "".join(f"{head:>14s}" for head in heads))
    for verdict in verdicts:
        print(f"{verdict.group + ' ' + verdict.place:38s}" + _row(verdict))
    report = {}
    for group in dict.fromkeys(verdict.group for verdict in verdicts):
        whole = _joined([verdict for verdict in verdicts if verdict.group == group])
        report[group] = whole.figures()
        print(f"{group:38s}" + _row(whole))
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if missed := list(_missed(report)):
        sys.exit("outside the targets: " + ", ".join(missed))


def _row(verdict: Verdict) -> str:
    return "".join(f"{value:14.4g}" for value in verdict.figures().values())


def _joined(verdicts: list[Verdict]) -> Verdict:
    return replace(
        verdicts[0],
        place="",
        called=np.concatenate([each.called for each in verdicts]),
        true=np.concatenate([each.true for each in verdicts]),
        seconds=max(each.seconds for each in verdicts),
    )


def _missed(report: dict[str, dict[str, float]]) -> Iterator[str]:
    for group, figures in report.items():
        limits = LIMITS if group.startswith("town") else {}
        yield from (f"{group}: {name}" for name, most in limits.items() if figures[name] >= most)
        if figures["right"] < LEAST_RIGHT:
            yield f"{group}: right"
        if figures["seconds"] > MOST_SECONDS:
            yield f"{group}: seconds"


def town(number: int, scans: tuple[str, ...], folder: Path) -> Iterator[Verdict]:
    """Yield verdicts of a town; houses, trees and cars are drawn by its number."""
    rng = np.random.default_rng([20261121, number])
    plan, net = town_plan(), folder / "town.net.xml"
    build_network(plan.nodes_xml, plan.edges_xml, NO_TURNS, net)
    network = read_network(net, origin=ORIGIN)
    roadside = Roadside(
        tree_gap_m=float(rng.uniform(9.0, 20.0)),
        house_gap_m=float(rng.uniform(26.0, 45.0)),
        house_setback_m=float(rng.uniform(8.0, 14.0)),
        car_share=float(rng.uniform(0.1, 0.4)),
    )
    scene = furnish(network, TERRAIN, rng=rng, roadside=roadside)
    write_lanelets(network, folder / "map.osm", terrain=TERRAIN, crs=UTM)
    tiles = gr.SightTiles.of(gr.make_tiles(gr.read_map(folder / "map.osm")))
    poses = [pose for k in (False, True) for pose in masts_of(scene, free=k)]
    targets, walls = tiles.centres + UP, building_walls(scene)
    hidden = [walls.hide(pose.position, targets) for pose in poses]
    for name in scans:
        classified, spacing = SCANS[name]
        strips = [replace(s, along_m=0.46 * spacing, across_m=0.46 * spacing) for s in DENSE]
        model = ScanModel(strips=tuple(strips))
        scan = fly(scene, rng=np.random.default_rng([number, 3]), model=model)
        if not classified:
            scan = replace(scan, category=np.ones_like(scan.category))
        path = folder / "town.laz"
        write_scan(scan, path, crs=UTM, flown=date(2026, 3, 14))
        yield judge(f"town, {name}", str(number), poses, tiles, path, hidden)


def levels(number: int, scans: tuple[str, ...], folder: Path) -> Iterator[Verdict]:
    """Yield verdicts of a place with two levels."""
    place = two_levels.draw(number)
    tiles = gr.SightTiles.of(two_levels.tiles(place))
    poses = two_levels.poses(place, number)
    hidden = two_levels.truth(place, poses, tiles.centres)
    for name in scans:
        classified, spacing = SCANS[name]
        path = two_levels.write_scan(
            place, folder / "levels.laz", seed=number, per_m2=8.0 / spacing**2,
            classified=classified,
        )  # fmt: skip
        yield judge(f"two levels, {name}", str(number), poses, tiles, path, hidden)


def judge(
    group: str, place: str, poses: list[gr.Pose], tiles: gr.SightTiles, path: Path,
    hidden: list[Booleans],
) -> Verdict:  # fmt: skip
    """Return the verdict of one place with one scan."""
    begin = time.perf_counter()
    scan = gr.SightScan([path], tiles)
    scan.read(poses)
    sights = [gr.find_sight(pose, tiles, scan) for pose in poses]
    seconds = time.perf_counter() - begin
    in_view = [sight.state != OUT_OF_VIEW for sight in sights]
    pairs = list(zip(sights, hidden, in_view, strict=True))
    return Verdict(
        group=group,
        place=place,
        called=np.concatenate([(s.state == IN_SIGHT)[view] for s, _, view in pairs]),
        true=np.concatenate([~h[view] for _, h, view in pairs]),
        seconds=seconds,
    )


if __name__ == "__main__":
    main()
