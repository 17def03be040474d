"""Settings of the road mask: every choice of its algorithm, with unit and source."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class RoadSettings:
    """How the roads of a map become levels, of which none passes over itself.

    Parameters
    ----------
    sample_m : float
        Spacing of the map's heights, and side of the squares that share one.
    near_m : float
        Two lanelets so close belong to one surface, unless ...
    step_m, steepest : float
        ... their heights differ by more than `step_m` and a slope of `steepest` (30 %: no road is
        so steep).
    same_area : float
        Share by which mending a polygon may change its area.
    max_extent_m : float
        A wider map has a node in the wrong place.
    most_blocks : int
        Roads in more squares of 256 m are no site: 4,000 are a city of 16 by 16 km, without a
        gap. Each takes 10 ms and more with points.
    """

    sample_m: float = 2.0
    near_m: float = 6.0
    step_m: float = 1.0
    steepest: float = 0.3
    same_area: float = 1e-3
    max_extent_m: float = 200_000.0
    most_blocks: int = 4_000


@dataclass(frozen=True, kw_only=True)
class MaskSettings:
    """How points on roads become cells of the road's surface.

    Sensitivity (`bench/mask.py --sensitivity`, a simulated town whose classes were removed): with
    any of the fields from `block_margin_m` to `least_cells` halved or doubled, heights move by
    under 1 mm at the median, and the share of cells by under 0.1 %; only a stricter core removes
    cells: `core_cells` 10 takes 1.4 %, `core_radius` 1 takes 5 %.

    Parameters
    ----------
    roads : RoadSettings
        Of the map.
    least_ground : float
        A scan with a smaller share of points in classes of ground is not classified.
    filter_margin_m : float
        What PDAL's ground filter reads around a road: wider than its window (SMRF, 18 m).
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
    square_m, bare_m2 : float
        A square without a point and with so much road is outside the scans.
    warn_outside : float
        Share of roads outside the scans from which on a warning is logged.
    warn_offset_m : float
        Height of the scan over the map from which on a warning is logged: as `same_level_m`.
    datum_m : float
        Height beyond which that is no vertical datum's: geoid undulations are under 107 m
        (EGM2008).
    least_covered, warn_covered : float
        Share of the road's cells inside the scans' extents below which there is no mask, and
        below which a warning is logged. A scan of 1 point/m2 fills 0.2 of the cells of 0.5 m.
    """

    roads: RoadSettings = field(default_factory=RoadSettings)
    least_ground: float = 0.01
    filter_margin_m: float = 30.0
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
    square_m: float = 16.0
    bare_m2: float = 20.0
    warn_outside: float = 0.001
    warn_offset_m: float = 2.0
    datum_m: float = 110.0
    least_covered: float = 0.02
    warn_covered: float = 0.1


DEFAULTS = MaskSettings()
