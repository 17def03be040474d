"""The methods that the bench compares on a scene, and the figures of each."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import own
import pandas as pd
from breakdown import by_group, step_errors, tile_groups
from causes import causes
from found import Found, found_by_peer, found_in
from passages import score_passages
from peers import hits, hits_closed, oracle
from scenes import SceneFiles
from score import score_occupancy
from tracks import compared, score_tracks

import gis_radar as gr

Figures = dict[str, Any]


class NotThereError(Exception):
    """A method that cannot run here; its text is the reason."""


def figures_of_table(site: SceneFiles, table: pd.DataFrame) -> Figures:
    """Return the figures of a table of occupancy: whole, and by groups of tiles."""
    truth = site.truth()
    groups = tile_groups(site.tiles(), truth, site.poses)
    return {
        "occupancy": asdict(score_occupancy(truth, table)),
        "by_tiles": by_group(truth, table, groups),
    }


def figures_of_dataset(site: SceneFiles, folder: Path) -> Figures:
    """Return all figures of a dataset."""
    return figures_of(site, found_in(gr.open_dataset(folder), site.truth()))


def figures_of(site: SceneFiles, found: Found) -> Figures:
    """Return all figures of vehicles that were found."""
    tiles, truth, traffic = site.tiles(), site.truth(), site.traffic()
    figures = figures_of_table(site, found.occupancy)
    scored = compared(tiles, truth, site.poses, traffic, found.states)
    figures["vehicles"] = score_tracks(scored, traffic.kinds)
    figures["by_vehicles"] = figures["vehicles"].pop("by")
    figures["causes"] = causes(site, scored)
    figures["steps"] = step_errors(found.occupied, tiles, truth)
    passed = found.passages
    passed = passed[passed["lanelet_id"].isin(site.lanelets_in_sight())]
    figures["passages"] = score_passages(site.passages(), passed)
    return figures


def _hits(site: SceneFiles) -> Figures:
    return figures_of_table(site, hits(site))


def _closed(site: SceneFiles) -> Figures:
    return figures_of_table(site, hits_closed(site))


def _oracle(site: SceneFiles) -> Figures:
    return figures_of_table(site, oracle(site))


def _stone_soup(site: SceneFiles) -> Figures:
    try:
        from stone_soup import stone_soup  # noqa: PLC0415 - a package of the bench alone
    except ImportError as error:
        raise NotThereError(str(error)) from error
    begin = time.process_time()
    found = stone_soup(site, site.poses)
    minutes = own.sensor_minutes(site, [pose.sensor for pose in site.poses])
    cost = {"sensor_minutes": minutes, "cpu_s": (time.process_time() - begin) / minutes}
    return figures_of(site, found_by_peer(site, found)) | {"costs": cost}


def _true_poses(site: SceneFiles) -> Figures:
    return _own(site, own.true_pose_files(site), "dataset-true")


def _found_poses(site: SceneFiles) -> Figures:
    files = own.found_poses(site)
    known = {"pose_errors": own.pose_errors(site, files)}
    return _own(site, files, "dataset-found") | known


def _own(site: SceneFiles, files: list[Path], name: str) -> Figures:
    folder = site.kept / name
    shutil.rmtree(folder, ignore_errors=True)
    ran = own.measure(site, files, folder)
    figures: Figures = {"code": ran.code, "warnings": ran.warnings, "errors": ran.errors}
    if ran.code == 0:
        figures |= figures_of_dataset(site, folder) | {"costs": own.costs(site, files, ran)}
    return figures


METHODS: Mapping[str, Callable[[SceneFiles], Figures]] = {
    "hits": _hits,
    "hits, gaps <= 1 s closed": _closed,
    "DBSCAN + Kalman + Hungarian (Stone Soup)": _stone_soup,
    "vehicles, true poses": _true_poses,
    "vehicles, found poses": _found_poses,
    "oracle association": _oracle,
}
SHORT = {
    "hits": "hits",
    "closed": "hits, gaps <= 1 s closed",
    "soup": "DBSCAN + Kalman + Hungarian (Stone Soup)",
    "true": "vehicles, true poses",
    "found": "vehicles, found poses",
    "oracle": "oracle association",
}
