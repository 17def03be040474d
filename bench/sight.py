"""Sight beside the truth of simulated places: towns with houses, and roads on two levels.

`wrongly seen` is the share of the tiles called in sight that are truly hidden, `lost` the share of
those truly in sight that are called hidden, `right` the share of all tiles in view that are called
what they are. Scans are with and without ASPRS classes, dense and thin. Exit code 1 where a figure
misses its target.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
from figures import EXACT_CHANCE, ROOT, SHARE_CHANCE, TARGET, TIME_CHANCE, Figure, report

import gis_radar as gr
from gis_radar.base import Booleans
from gis_radar.scans import IN_SIGHT, OUT_OF_VIEW, SightScan, SightTiles
from simulation.lanelet_writer import write_lanelets
from simulation.network import build_network, read_network
from simulation.roadside import Roadside, furnish
from simulation.scan import ScanModel, Strip, fly, write_scan
from simulation.sight import building_walls

sys.path.append(str(ROOT / "bench" / "localization"))
import two_levels
from places import ORIGIN, UTM
from town import TERRAIN, masts_of, town_plan

from simulation.street_plans import NO_TURNS

TOWNS, LEVELS = (4, 7), (1, 2, 3)
DENSE = (Strip(heading_deg=24.0, slant=0.16), Strip(heading_deg=208.0, slant=0.1))
# By name: whether points have classes, and the distance of points as a multiple of the dense one.
SCANS = {"classes": (True, 1.0), "no classes": (False, 1.0), "thin, no classes": (False, 2.2)}
MOST_SECONDS, LEAST_PERCENT = 10.0, 0.1  # target of the time; smaller differences are chance
# Of the tiles in view: in sight as called, and truly; seconds for the scan and all sensors.
Verdict = tuple[Booleans, Booleans, float]


def main() -> None:
    """Find sight at each place with each scan, and judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--towns", type=int, nargs="*", default=TOWNS)
    parser.add_argument("--levels", type=int, nargs="*", default=LEVELS)
    parser.add_argument("--scans", nargs="*", choices=SCANS, default=tuple(SCANS))
    arguments = parser.parse_args()
    found: dict[str, list[Verdict]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for make, numbers in ((town, arguments.towns), (levels, arguments.levels)):
            for number in numbers:
                for group, verdict in make(number, arguments.scans, Path(folder)):
                    found.setdefault(group, []).append(verdict)
    report(
        "sight", (each for group, verdicts in found.items() for each in _figures(group, verdicts))
    )


def _figures(group: str, verdicts: list[Verdict]) -> Iterator[Figure]:
    """Yield the figures of a kind of place with a kind of scan, over all places and sensors."""
    called, true = (np.concatenate(flags) for flags in list(zip(*verdicts, strict=True))[:2])
    shares = {
        "right": (called == true).mean(), "wrongly seen": (~true[called]).mean(),
        "lost": (~called[true]).mean(),
    }  # fmt: skip
    wanted = (
        {"right": 95.0} if group.startswith("two levels") else {"wrongly seen": 2.0, "lost": 3.0}
    )
    for name, target in wanted.items():
        better = name == "right"
        yield Figure(
            what=f"sight, {group}: {name}", ours=100.0 * float(shares[name]), unit="%",
            peer=target, peer_name=TARGET, more_is_better=better,
            chance=EXACT_CHANCE if better else SHARE_CHANCE, least=0.0 if better else LEAST_PERCENT,
        )  # fmt: skip
    seconds = max(verdict[2] for verdict in verdicts)
    yield Figure(
        what=f"sight, {group}: scan and all sensors of a place", ours=seconds, unit="s",
        peer=MOST_SECONDS, peer_name=TARGET, chance=TIME_CHANCE,
    )  # fmt: skip


def town(number: int, scans: tuple[str, ...], folder: Path) -> Iterator[tuple[str, Verdict]]:
    """Yield the verdict of a town with each scan; its number draws houses, trees and cars."""
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
    tiles = SightTiles.of(gr.make_tiles(gr.read_map(folder / "map.osm")))
    poses = [pose for k in (False, True) for pose in masts_of(scene, free=k)]
    targets, walls = tiles.centres + two_levels.UP, building_walls(scene)
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
        yield f"town, {name}", judge(poses, tiles, path, hidden)


def levels(number: int, scans: tuple[str, ...], folder: Path) -> Iterator[tuple[str, Verdict]]:
    """Yield the verdict of a place of two levels with each scan."""
    place = two_levels.draw(number)
    tiles = SightTiles.of(two_levels.tiles(place))
    poses = two_levels.poses(place, number)
    hidden = two_levels.truth(place, poses, tiles.centres)
    for name in scans:
        classified, spacing = SCANS[name]
        path = two_levels.write_scan(
            place, folder / "levels.laz", seed=number, per_m2=8.0 / spacing**2,
            classified=classified,
        )  # fmt: skip
        yield f"two levels, {name}", judge(poses, tiles, path, hidden)


def judge(poses: list[gr.Pose], tiles: SightTiles, path: Path, hidden: list[Booleans]) -> Verdict:
    """Return the verdict on a place with a scan, over all sensors; `hidden` is the truth."""
    begin = time.perf_counter()
    scan = SightScan([path], tiles)
    scan.read(poses)
    sights = [gr.find_sight(pose, tiles, scan) for pose in poses]
    seconds = time.perf_counter() - begin
    in_view = [sight.state != OUT_OF_VIEW for sight in sights]
    pairs = list(zip(sights, hidden, in_view, strict=True))
    called = np.concatenate([(s.state == IN_SIGHT)[view] for s, _, view in pairs])
    return called, np.concatenate([~h[view] for _, h, view in pairs]), seconds


if __name__ == "__main__":
    main()
