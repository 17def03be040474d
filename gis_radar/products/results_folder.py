"""Write the files of a result into one folder, which appears whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from gis_radar.base import (
    QUIET,
    Reporter,
    atomic_folder,
    current_language,
    keep_styles,
    output_errors,
    speaking,
    writing_errors,
)


def write_results(
    folder: str | Path, writers: Mapping[str, Callable[[Path], object]], *, name: str, stage: str,
    language: str | None = None, reporter: Reporter = QUIET,
) -> list[Path]:  # fmt: skip
    """Write files, and keep the styles that a user gave to the layers of an earlier result.

    Parameters
    ----------
    folder : str or Path
        Where; an earlier result there is replaced.
    writers : mapping
        By name of the file, what writes it to a path; in this order, all into one folder. A folder
        whose names are these up to the first point counts as an earlier result, which goes.
    name : str
        Of the GeoPackage, without its ending.
    stage : str
        What progress is called.
    language : str, optional
        Of what is written, `en` or `de`; the current one without it.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    OutputError
        If the folder cannot be written, or holds other files.
    """
    folder, package = Path(folder), f"{name}.gpkg"
    owned = tuple(sorted({f"{each.partition('.')[0]}." for each in (*writers, package)}))
    with (
        speaking(language or current_language()),
        atomic_folder(folder, owned=owned, reporter=reporter) as fresh,
    ):
        for done, (file, write) in enumerate(writers.items(), start=1):
            with output_errors(folder / file), writing_errors(folder / file):
                write(fresh / file)
            reporter.progress(stage, done, len(writers))
        keep_styles(fresh / package, earlier=folder / package)
    return [folder / file for file in writers]
