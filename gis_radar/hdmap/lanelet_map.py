"""A Lanelet2 map as one object: its lanelets, what rules them, lanes and stop lines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
from pyproj import CRS

from gis_radar.base import QUIET, Reporter, card, name_of
from gis_radar.hdmap.lanes import find_stop_lines, make_lanes

REPAIRED, LEFT_OUT, DOUBTFUL = "repaired", "left out", "doubtful"  # actions of problems


@dataclass(frozen=True, kw_only=True)
class LaneletMap:
    """A Lanelet2 map in one metric system.

    Parameters
    ----------
    lanelets : GeoDataFrame
        Sorted by `lanelet_id` (int64). `subtype`; `location`, `street` (its name) and
        `turn_direction` (None where not tagged);
        `speed_limit_kmh` (NaN where unknown); `one_way`; `participants`, `successors`,
        `predecessors` (tuples); `left`, `right`, `centre` (lines in driving direction, with
        heights where these are known); the outline as geometry.
    regulatory : GeoDataFrame
        A row for each member of a regulatory element: `element_id`, `subtype` of the element,
        `role` of the member, `lanelet_ids` (tuple: lanelets that name the element), `member_id`,
        `member_type` (`stop_line`, `traffic_light`, ...), `member_sign` (such as `de205`), and the
        member's geometry, if it has one. Stop lines that no element names are rows of their own.
    problems : GeoDataFrame
        `lanelet_id`, `action` (`repaired`, `left out`, or `doubtful` for one that is kept),
        `reason`, geometry (or None).
    crs : CRS
        The system of all coordinates.
    remarks : tuple of str
        Remarks for the user on the reading of the map.
    """

    lanelets: gpd.GeoDataFrame
    regulatory: gpd.GeoDataFrame
    problems: gpd.GeoDataFrame
    crs: CRS
    remarks: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """Return key figures by name."""
        done = self.problems["action"].value_counts()
        return {
            "lanelets": len(self.lanelets),
            "length_km": round(float(self.lanelets["centre"].length.sum()) / 1000.0, 3),
            "crs": name_of(self.crs),
            REPAIRED: int(done.get(REPAIRED, 0)),
            LEFT_OUT: int(done.get(LEFT_OUT, 0)),
        }

    def lanes(
        self,
        *,
        streets: gpd.GeoDataFrame | str | Path | None = None,
        street_field: str | None = None,
        reporter: Reporter = QUIET,
    ) -> gpd.GeoDataFrame:
        """Return the lanes, with street, direction and turns.

        A lane is a chain of lanelets, each the only successor of its only predecessor.

        Parameters
        ----------
        streets : GeoDataFrame, str or Path, optional
            Lines of streets with names, in any coordinate system, such as a layer of the city.
            Lanes named in the map keep their name; others get that of the street along most of
            their length.
        street_field : str, optional
            Its column of names; without it the first of the usual ones.
        reporter : Reporter
            Receives remarks on lanes without names and on streets of one name.

        Returns
        -------
        GeoDataFrame
            One row a lane, by `lane` (int64, its number: its smallest lanelet id). `lanelets`
            (tuple of int, in driving order); `subtype` of the first; `street` (None where unknown);
            `street_part` (of several streets of that name more than 250 m apart, which one: by its
            place among them, a compass wind such as `north-east`, else a number; None for a single
            street); `direction` (of its last 5 m: one of eight compass winds, from grid north);
            `turn` (`left`, `straight`, `right`, `back`, joined by `;`: the turns in a junction of
            the lane or of those that it leads to, by the map's tags, else by geometry; None
            elsewhere); `stop_line_m` (metres along the lane, NaN where the map has none);
            `length_m`; `speed_limit_kmh` (mean speed of a vehicle that drives at the limits, NaN
            where the map does not state them all); its centre line as geometry.

        Raises
        ------
        InputError
            If the streets cannot be read, or have no column of that name.
        CrsError
            If the streets state no coordinate system.

        Examples
        --------
        >>> import gis_radar as gr
        >>> lanes = gr.read_map(gr.sample_folder() / "junction.osm").lanes()
        >>> lanes[["lane", "direction", "turn"]].head(2)  # doctest: +SKIP
        """
        return make_lanes(
            self.lanelets, self.regulatory, streets=streets, street_field=street_field,
            reporter=reporter,
        )  # fmt: skip

    def stop_lines(self) -> gpd.GeoDataFrame:
        """Return the stop lines, a row for each lane that one ends.

        A stop line ends the lanes that it crosses, and those that end up to 2 m before it. If
        lanelets name its regulatory element, only these count.

        Returns
        -------
        GeoDataFrame
            `stop_line` (int64, the way's id), `lane`, `lanelet_id` (int64), `s_m` along the lanelet
            and `lane_m` along the lane, metres; `sign` (such as `de294`; empty where none); the
            line.
        """
        return find_stop_lines(self.lanelets, self.regulatory)

    def __repr__(self) -> str:
        shown = self.figures()
        return (
            f"LaneletMap({shown['lanelets']} lanelets, {shown['length_km']} km, {shown['crs']}; "
            f"{shown[REPAIRED]} {REPAIRED}, {shown[LEFT_OUT]} {LEFT_OUT})"
        )

    def _repr_html_(self) -> str:
        return card("Lanelet map", self.figures())
