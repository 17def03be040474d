"""Write the files of a result into one folder, which appears whole or not at all, and XML."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, indent

from gis_radar.base import (
    QUIET,
    Reporter,
    atomic_folder,
    copy_saved_styles,
    in_language,
    output_errors,
    writing_errors,
)


def write_results(
    folder: str | Path, writers: Mapping[str, Callable[[Path], object]], *, name: str,
    owned: Sequence[str] = (), stage: str = "", language: str | None = None,
    reporter: Reporter = QUIET,
) -> list[Path]:  # fmt: skip
    """Write files, and keep the styles that a user gave to the layers of an earlier result.

    Parameters
    ----------
    folder : str or Path
        The folder; an earlier result there is replaced.
    writers : mapping
        By name of the file, a function that writes it to a path; called in this order.
    name : str
        Name of the GeoPackage, without its suffix.
    owned : sequence of str
        What the names of the files of an earlier result begin with; by default these files' names
        up to the first point.
    stage : str
        Name of the stage for progress; without one the writers report theirs.
    language : str, optional
        Language of the files, `en` or `de`; by default the current one.
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
    own = {f"{each.partition('.')[0]}." for each in (*writers, package)}
    begins = tuple(owned or sorted(own))
    with in_language(language), atomic_folder(folder, owned=begins, reporter=reporter) as fresh:
        for done, (file, write) in enumerate(writers.items(), start=1):
            with output_errors(folder / file), writing_errors(folder / file):
                write(fresh / file)
            if stage:
                reporter.progress(stage, done, len(writers))
        copy_saved_styles(fresh / package, earlier=folder / package)
    return [folder / file for file in writers]


def write_xml(root: Element, path: Path) -> None:
    """Write a document of XML, indented, in UTF-8."""
    indent(root)
    ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
