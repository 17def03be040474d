"""What each component of the tracker is worth: the figures of a scene with it switched off."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from methods import MISSING, Figures, NotThereError, figures_of_folder
from scenes import SceneFiles

import gis_radar as gr

NOTHING = "nothing"


def ablate(site: SceneFiles) -> Iterator[tuple[str, Figures]]:
    """Yield the name of each component and the figures without it; first those of the whole.

    With true poses, so that nothing but the component differs.
    """
    find: Any = getattr(gr, "find_vehicles", None)
    if find is None:
        raise NotThereError(MISSING)
    settings = import_module("gis_radar.vehicles.settings")

    whole = settings.VehicleSettings()
    for name, changed in {NOTHING: whole, **switched_off(whole)}.items():
        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / "vehicles"
            find(
                site.recordings, site.poses, site.tiles(), site.map, made, scans=[site.scan],
                settings=changed,
            )  # fmt: skip
            yield name, figures_of_folder(site, made)


def switched_off(settings: Any) -> dict[str, Any]:
    """Return settings by the name of the one switch that is off in them.

    Switches are the fields that are True, of the record itself and of the records in it.
    """
    found: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if value is True:
            found[field.name] = dataclasses.replace(settings, **{field.name: False})
        elif dataclasses.is_dataclass(value):
            for name, inner in switched_off(value).items():
                changed = dataclasses.replace(settings, **{field.name: inner})
                found[f"{field.name}.{name}"] = changed
    return found
