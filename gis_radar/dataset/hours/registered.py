"""Hours as the folder of a dataset registers them: which are missing, and how one is made.

A task is a folder and an hour. Everything else lies in the folder, so that any process that sees
it can make the hour: a worker here, or one of a cluster.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from gis_radar.base import QUIET, InputError
from gis_radar.dataset.files.manifest import BRING_BACK, MANIFEST, MAP, Manifest, tiles_of_dataset
from gis_radar.dataset.files.parts import part_path
from gis_radar.dataset.files.records import HourRecord
from gis_radar.dataset.files.registry import Registry, source_of, touched_hours, validity_by_sensor
from gis_radar.dataset.files.tables import TABLES
from gis_radar.dataset.hours.job import HOUR_METHOD, HourSite, MadeHour, MeasureSettings, make_hour
from gis_radar.hdmap import lane_graph
from gis_radar.tracking import map_of_tiles

_MOST_SITES = 8  # that a process keeps, tens of MB each: consecutive hours are of few sites

_sites: dict[str, HourSite] = {}  # kept by this process, by `_site_key`


def measure_settings_of(manifest: Manifest, folder: Path) -> MeasureSettings:
    """Return the settings of a dataset.

    Raises
    ------
    InputError
        If they are damaged.
    """
    try:
        return MeasureSettings.from_dict(manifest.settings)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError("{}: damaged: {}", folder / MANIFEST, f"{error!r:.200}") from error


def site_of(folder: Path, manifest: Manifest) -> HourSite:
    """Return the inputs that all hours of a dataset have in common, read once in a process.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    manifest : Manifest
        Its manifest.
    """
    key = _site_key(folder, manifest)
    if key not in _sites:
        settings = measure_settings_of(manifest, folder)
        tiles, graph = tiles_of_dataset(folder, manifest), None
        if settings.vehicles:
            roads, described = map_of_tiles(folder / MAP, tiles, QUIET)
            if described["digest"] != manifest.map:
                raise InputError("{}: is of another run", folder / MAP, hint=BRING_BACK)
            graph = lane_graph(roads.lanelets)
        while len(_sites) >= _MOST_SITES:
            del _sites[next(iter(_sites))]
        _sites[key] = HourSite(
            folder=folder, tiles=tiles, graph=graph, origin=manifest.origin, settings=settings
        )
    return _sites[key]


@contextmanager
def kept_site(site: HourSite) -> Iterator[None]:
    """Keep the site of a dataset for :func:`site_of` in this process and those that it forks."""
    key = _site_key(site.folder, Manifest.read(site.folder))
    _sites[key] = site
    try:
        yield
    finally:
        _sites.pop(key, None)


def _site_key(folder: Path, manifest: Manifest) -> str:
    """Return folder and manifest as text, without the findings of checks."""
    known = {**asdict(manifest), "checks": None}
    return json.dumps([str(folder.absolute()), known], sort_keys=True, default=str)


def hours_to_make(
    registry: Registry, records: Mapping[int, HourRecord], margin: int, asked: Iterable[int] = ()
) -> list[int]:
    """Return the hours that have to be made, ascending.

    These are hours that were not made with all recordings that reach into them, hours with a
    missing part, and, of the `asked` ones, hours of an earlier method whose recordings exist.
    """
    complete = {hour for hour, record in records.items() if is_complete(registry.folder, record)}
    expected = set(registry.hours)
    outdated = {
        hour for hour in expected.intersection(asked, records)
        if records[hour].origin.method != HOUR_METHOD and not records[hour].dropped
    }  # fmt: skip
    missing = [each for each in registry.entries if outdated and not Path(each.path).is_file()]
    outdated -= {*touched_hours(outdated, missing, margin)}  # they cannot be made again: they stay
    return sorted({*registry.missing_hours(margin), *(expected - complete), *outdated})


def is_complete(folder: Path, record: HourRecord) -> bool:
    """Return whether all parts of an hour are there, with the sizes in its record."""
    kept = {name: part for name, part in record.parts.items() if name not in record.dropped}
    for name, part in kept.items():
        path = part_path(folder, TABLES[name], record.hour)
        if not path.is_file() or path.stat().st_size != part.size:
            return False
    return True


def make_registered(folder: Path, hour: int, processes: int = 1) -> MadeHour:
    """Make an hour with all registered recordings that reach into it.

    Parameters
    ----------
    folder : Path
        Folder of the dataset; the caller, or the process that sent the task, is its only writer.
    hour : int
        The hour since 1970.
    processes : int
        Number of blocks of the hour in which vehicles are looked for in parallel.

    Raises
    ------
    InputError
        As for :func:`~gis_radar.dataset.hours.job.make_hour`.
    """
    manifest = Manifest.read(folder)
    margin = measure_settings_of(manifest, folder).margin
    registry = Registry.read(folder, manifest.fingerprint, hour=hour, margin=margin)
    site, validity_s = site_of(folder, manifest), validity_by_sensor(registry.entries)
    sources = [source_of(*registry.placing(each)) for each in registry.entries]
    return make_hour(site, hour, sources, validity_s, processes=processes)
