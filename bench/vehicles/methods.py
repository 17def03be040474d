"""The methods that the bench compares on a scene, and the figures of each."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import own
import pandas as pd
from ablated import PARTS
from found import Found, found_by_peer, found_in
from passages import score_passages
from peers import hits, oracle
from scenes import SceneFiles
from score import score_by_tiles, score_occupancy
from tracks import compared, score_tracks

import gis_radar as gr

Figures = dict[str, Any]


class NotThereError(Exception):
    """Error of a method that cannot run here; its text is the reason."""


def figures_of_table(site: SceneFiles, table: pd.DataFrame) -> Figures:
    """Return the figures of a table of occupancy: whole, and by groups of tiles."""
    truth = site.truth()
    return {
        "occupancy": asdict(score_occupancy(truth, table)),
        "by_tiles": score_by_tiles(truth, table, site.tiles(), site.poses),
    }


def figures_of_dataset(site: SceneFiles, folder: Path) -> Figures:
    """Return all figures of a dataset."""
    return figures_of(site, found_in(gr.open_dataset(folder)))


def figures_of(site: SceneFiles, found: Found) -> Figures:
    """Return the figures of found vehicles: occupancy, states, passages."""
    figures = figures_of_table(site, found.occupancy)
    scored = compared(site.tiles(), site.truth(), site.traffic(), found.states)
    figures["vehicles"] = score_tracks(scored)
    passed = found.passages
    passed = passed[passed["lanelet_id"].isin(site.lanelets_in_sight())]
    figures["passages"] = score_passages(site.passages(), passed)
    return figures


def with_constants(site: SceneFiles, values: Mapping[str, Any]) -> Figures:
    """Return the figures with other constants of the tracker.

    Parameters
    ----------
    site : SceneFiles
        A scene.
    values : mapping
        Values by module and name, such as ``start.links.END_COST``. A module that imports the
        constant is given on its own. Compiled code reads constants when it is first called: use a
        new process for other values.
    """
    changes = []
    for place, value in values.items():
        module, name = place.rsplit(".", 1)
        changes.append(patch.object(import_module(f"gis_radar.tracking.{module}"), name, value))
    return _changed(site, changes)


def without(site: SceneFiles, off: str) -> Figures:
    """Return the figures without parts of the tracker: names of `PARTS` with + between them."""
    return _changed(site, [change() for name in off.split("+") for change in PARTS[name]])


def _changed(site: SceneFiles, changes: Iterable[AbstractContextManager[Any]]) -> Figures:
    """Return the figures with true poses within some contexts."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        for change in changes:
            stack.enter_context(change)
        begin = time.process_time()
        dataset = own.measured(site, Path(folder) / "dataset", found=False)
        cpu_s = (time.process_time() - begin) / own.sensor_minutes(site)
        return figures_of(site, found_in(dataset)) | {"costs": {"cpu_s": cpu_s}}


def _stone_soup(site: SceneFiles) -> Figures:
    try:
        from stone_soup import stone_soup  # noqa: PLC0415 - a package of the bench alone
    except ImportError as error:
        raise NotThereError(str(error)) from error
    return figures_of(site, found_by_peer(site, stone_soup(site, site.poses)))


def _true_poses(site: SceneFiles) -> Figures:
    return _own(site, own.true_pose_files(site), "dataset-true")


def _found_poses(site: SceneFiles) -> Figures:
    files = own.found_poses(site)
    return _own(site, files, "dataset-found") | {"pose_errors": own.pose_errors(site, files)}


def _own(site: SceneFiles, files: list[Path], name: str) -> Figures:
    folder = site.kept / name
    shutil.rmtree(folder, ignore_errors=True)
    ran = own.measure(site, files, folder)
    if ran.code:
        return {"code": ran.code, "errors": own.messages(ran, "error")}
    return figures_of_dataset(site, folder) | {"costs": own.costs(site, files, ran)}


METHODS: Mapping[str, Callable[[SceneFiles], Figures]] = {
    "hits": lambda site: figures_of_table(site, hits(site)),
    "soup": _stone_soup,
    "true": _true_poses,
    "found": _found_poses,
    "oracle": lambda site: figures_of_table(site, oracle(site)),
}
