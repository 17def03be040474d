"""Public names of version 0.1 that went: programs run on with them, and are told what to use."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Any

# By name: where it is now, which a program may rely on less than on a public name.
MOVED = {
    "moved_position": "gis_radar.crs",
    "name_of": "gis_radar.crs",
    "require_road_name": "gis_radar.scans.mask",
    "require_scans_near": "gis_radar.second_look.second_look",
    "road_crs": "gis_radar.scans.scan",
}
REPLACED = {"to_xarray": "gis_radar.make_heatmap(..., begin=, end=, tile_ids=).to_xarray()"}


def earlier(name: str) -> Any:
    """Return what a public name of version 0.1 stood for, with a warning.

    Parameters
    ----------
    name : str
        The name.

    Raises
    ------
    AttributeError
        If version 0.1 had none of that name, or it is public still.
    """
    if name not in MOVED and name not in REPLACED:
        raise AttributeError(name)
    now = f"{MOVED[name]}.{name}" if name in MOVED else REPLACED[name]
    text = f"gis_radar.{name} of version 0.1 is no public name any more; use {now}"
    warnings.warn(text, DeprecationWarning, stacklevel=3)
    return getattr(import_module(MOVED[name]), name) if name in MOVED else _to_xarray


def _to_xarray(
    occupancy: Any,
    tiles: Any,
    *,
    within: tuple[str, str] | None = None,
    most_mib: float | None = None,
    **options: Any,
) -> Any:
    """Return occupancy over tiles and times, as `to_xarray` of version 0.1 did."""
    from gis_radar.heatmap import make_heatmap  # noqa: PLC0415 - heavy

    begin, end = within or (None, None)
    heat = make_heatmap(occupancy, tiles, begin=begin, end=end, **options)
    return heat.to_xarray() if most_mib is None else heat.to_xarray(most_mib=most_mib)
