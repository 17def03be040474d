"""Changes, methods of a dataset: recordings withdrawn or found again, exact tables deleted."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from pathlib import Path

from gis_radar.base import QUIET, Reporter
from gis_radar.dataset.files.source import DatasetFiles


def withdraw(
    dataset: DatasetFiles, recordings: Sequence[str | Path] = (), *, sensor: str | None = None,
    day: date | str | None = None, processes: int = 1, reporter: Reporter = QUIET,
) -> list[str]:  # fmt: skip
    """Withdraw recordings; the hours that they reach into are made again.

    Parameters
    ----------
    recordings : sequence of paths
        Paths, or file names where these are unique. The files may be gone; those of all other
        recordings of the same hours must be there.
    sensor : str, optional
        In place of `recordings`: all those of a sensor.
    day : date or str, optional
        In place of `recordings`: all those of a day by the clocks of the site, such as
        2026-10-05; with `sensor`, only that sensor's. They must lie in the day, to a second.
    processes : int
        Number of hours, or of blocks of an hour, made in parallel.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    list of str
        Paths of the recordings that were withdrawn.

    Raises
    ------
    UsageError
        If nothing is named, or recordings and a sensor or day.
    InputError
        If there is no such recording, one reaches out of the day, another needed one is missing
        or changed, or exact tables of their hours were deleted.
    """
    from gis_radar.dataset.hours.upkeep import withdraw  # noqa: PLC0415 - 0.6 s

    return withdraw(dataset, recordings, sensor, day, processes, reporter)


def keep(dataset: DatasetFiles, days: float, *, reporter: Reporter = QUIET) -> list[str]:
    """Delete the exact tables of old hours, so that room stays for new ones.

    Tile counts, lane measures, turns, vehicles and passages stay; they are brought up to date
    before. The hours take no recordings any more.

    Parameters
    ----------
    days : float
        Hours that ended longer ago lose `frames`, `hits`, `observed`, `visible`, `occupied` and
        `tracks`; the last of them keeps its own, from which vehicles go on in the next hour.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    list of str
        Begins of the hours, ISO 8601.

    Raises
    ------
    UsageError
        If `days` is negative or no number.
    InputError
        If counts of these hours cannot be made or read; then nothing is deleted.
    """
    from gis_radar.dataset.hours.upkeep import keep  # noqa: PLC0415 - the tracker, 0.6 s

    return keep(dataset.folder, days, dataset.manifest.fingerprint, reporter=reporter)


def relink(dataset: DatasetFiles, search: str | Path, *, reporter: Reporter = QUIET) -> int:
    """Find recordings whose files were moved, by their contents, and return how many.

    Parameters
    ----------
    search : str or Path
        A folder; in it and in the folders below, all files with the suffix of a missing
        recording are compared.
    reporter : Reporter
        Receives progress, and a warning for each recording that is not found.

    Raises
    ------
    InputError
        If there is no such folder.
    """
    from gis_radar.dataset.hours.upkeep import relink  # noqa: PLC0415 - the tracker, 0.6 s

    return relink(dataset.folder, search, dataset.manifest.fingerprint, reporter)
