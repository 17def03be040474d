"""Settings of the road mask: what may be set of its algorithm, with unit and source."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class MaskSettings:
    """How points on roads become cells of the road's surface.

    Sensitivity (`bench/mask.py --sensitivity`, a simulated town whose classes were removed): with
    any of the fields halved or doubled, heights move by
    under 1 mm at the median, and the share of cells by under 0.1 %; only a stricter core removes
    cells: `core_cells` 10 takes 1.4 %, `core_radius` 1 takes 5 %.

    Parameters
    ----------
    block_margin_m : float
        What the surface of a block of 256 m reads around it; up to 100 m.
    offset_bin_m, offset_max_m : float
        Bins and range of the histogram in which the scan's heights over the map's are found: geoid
        undulations are under 110 m.
    offset_points : int
        Points of a block that enter it.
    same_level_m : float
        Points farther from the map's height are of another level (the contract's).
    clearance_m : float
        The same for cells without such points; less than what passes under a bridge (4.5 m).
    node_m : float
        Distance of the nodes of the ground surface.
    low_m : float
        Side of the squares whose lowest point pulls the surface.
    stiffness : tuple of float
        Weight of bending by round: bends shorter than some 40 m, then 20 m, are flattened.
    object_m : float
        Points higher over the surface are objects: tyres, kerbs and bonnets are.
    pull_m : float
        Points farther below it pull with bounded force (Huber 1964).
    surface_m : float
        Points nearer to the surface are the road's; six times the noise of a scan (0.03 m).
    core_radius, core_cells : int
        DBSCAN (Ester et al. 1996) on cells: a core has so many cells within so many.
    least_cells : int
        Smaller clusters are left out; 5 m2 are less than a car's outline.
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
