"""Withdraw recordings from a dataset, or find recordings whose files were moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import geopandas as gpd

from gis_radar.base import InputError, Reporter, Text
from gis_radar.dataset.hour_job import HourSite, MeasureSettings
from gis_radar.dataset.making import change, writing
from gis_radar.dataset.manifest import MANIFEST, MAP, Manifest
from gis_radar.dataset.registry import (
    RecordingEntry,
    Registry,
    digest_of,
    touched_hours,
)
from gis_radar.hdmap import lane_graph
from gis_radar.tracking import map_of_tiles


def withdraw(
    folder: Path, recordings: Sequence[str | Path], tiles: gpd.GeoDataFrame, fingerprint: str, *,
    processes: int, reporter: Reporter,
) -> None:  # fmt: skip
    """Withdraw recordings from a dataset; see :meth:`gis_radar.Dataset.withdraw`."""
    with writing(folder, reporter):
        manifest = Manifest.read(folder)  # others may have written since it was opened
        settings = _settings(manifest, folder)
        before = Registry.read(folder, fingerprint)
        gone = [_named(before, each) for each in recordings]
        kept = tuple(each for each in before.entries if each not in gone)
        hours = touched_hours(before.hours, gone, settings.margin)
        poses = before.poses.of(each.pose for each in kept)
        after = replace(before, entries=kept, poses=poses).without_hours(hours)
        tiles = tiles.sort_values("tile_id", ignore_index=True)
        graph = None
        if settings.vehicles:
            graph = lane_graph(map_of_tiles(folder / MAP, tiles, reporter)[0].lanelets)
        site = HourSite(
            folder=folder, tiles=tiles, graph=graph, origin=manifest.origin,
            settings=settings,
        )  # fmt: skip
        change(site, before, after, processes=processes, reporter=reporter)
        sensors = {each.sensor for each in kept}
        checks = {name: of for name, of in manifest.checks.items() if name in sensors}
        if checks != manifest.checks:
            replace(manifest, checks=checks).write(folder)


def _settings(manifest: Manifest, folder: Path) -> MeasureSettings:
    try:
        return MeasureSettings.from_dict(manifest.settings)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError("{}: damaged: {}", folder / MANIFEST, f"{error!r:.200}") from error


def relink(folder: Path, search: str | Path, fingerprint: str, reporter: Reporter) -> int:
    """Find recordings that were moved; see :meth:`gis_radar.Dataset.relink`."""
    if not Path(search).is_dir():
        raise InputError("{}: is no folder", search, hint="name one to look for recordings in")
    with writing(folder, reporter):
        registry = Registry.read(folder, fingerprint)
        lost = {each.digest: each for each in registry.entries if not _is_there(each)}
        found: dict[str, Path] = {}
        endings = {Path(each.path).suffix.lower() for each in lost.values()}
        paths = sorted(
            path for path in Path(search).rglob("*")
            if path.suffix.lower() in endings and path.is_file()
        )  # fmt: skip
        for done, path in enumerate(paths):
            digest = digest_of(path)
            if digest in lost:
                found.setdefault(digest, path.resolve())
            reporter.progress("looking for recordings", done + 1, len(paths))
        entries = tuple(
            replace(each, path=found[each.digest].as_posix()) if each.digest in found else each
            for each in registry.entries
        )
        replace(registry, entries=entries).write_recordings()
    for digest, entry in lost.items():
        if digest not in found:
            reporter.warn("{}: is not in {}", entry.path, search)
    return len(found)


def _is_there(entry: RecordingEntry) -> bool:
    path = Path(entry.path)
    return path.is_file() and digest_of(path) == entry.digest


def _named(registry: Registry, recording: str | Path) -> RecordingEntry:
    """Return the one recording with a path or file name."""
    path = Path(recording)
    same = [each for each in registry.entries if Path(each.path) == path.resolve()]
    same = same or [each for each in registry.entries if Path(each.path).name == str(recording)]
    if len(same) == 1:
        return same[0]
    names = ", ".join(each.path for each in same or registry.entries)
    what = "has no recording" if not same else "has several recordings"
    raise InputError(
        "{}: {} {}", registry.folder, what, recording, hint=Text("name one of {}", names)
    )
