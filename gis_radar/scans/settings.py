"""Settings of the road mask, with their units and sources."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class MaskSettings:
    """How points on roads become cells of the road's surface.

    Sensitivity (a simulated town whose classes were removed): with
    any field halved or doubled, heights change by under 1 mm at the median and the share of cells
    by under 0.1 %; only a stricter core removes cells: 1.4 % with `core_cells` 10, 5 % with
    `core_radius` 1.

    Parameters
    ----------
    block_margin_m : float
        Margin around a block of 256 m whose points its surface is fitted to, too; up to 100 m.
    offset_bin_m, offset_max_m : float
        Width of bins, and range to either side, of the histogram of the scan's heights over the
        map's: geoid undulations are under 110 m.
    offset_points : int
        Points of a block that are counted in it.
    same_level_m : float
        Points farther from the map's height are of another level (the contract).
    clearance_m : float
        The same for cells without points within `same_level_m`; less than the clearance under a
        bridge (4.5 m).
    node_m : float
        Distance of the nodes of the ground surface.
    low_m : float
        Side of the squares to whose lowest points the surface is fitted.
    stiffness : tuple of float
        Weight of bending in each round: bends shorter than some 40 m, then 20 m, are flattened.
    object_m : float
        Points higher over the surface are objects, such as tyres, kerbs and bonnets.
    pull_m : float
        Points farther below the surface have bounded weight (Huber 1964).
    surface_m : float
        Points nearer to the surface are the road's; six times the noise of a scan (0.03 m).
    core_radius, core_cells : int
        DBSCAN (Ester et al. 1996) on cells: a core has `core_cells` cells within `core_radius`.
    least_cells : int
        Smaller clusters are left out; 20 cells are 5 m2, less than a car's outline.
    """

    block_margin_m: float = 32.0
    offset_bin_m: float = 0.25
    offset_max_m: float = 500.0
    offset_points: int = 20_000
    same_level_m: float = 2.0
    clearance_m: float = 4.0
    node_m: float = 4.0
    low_m: float = 1.0
    stiffness: tuple[float, ...] = (100.0, 100.0, 100.0, 100.0, 30.0, 30.0, 10.0, 10.0, 10.0)
    object_m: float = 0.3
    pull_m: float = 0.3
    surface_m: float = 0.2
    core_radius: int = 2
    core_cells: int = 5
    least_cells: int = 20


DEFAULTS = MaskSettings()
