"""Export the traffic of a dataset: tables, a spreadsheet, layers for QGIS, files for SUMO."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    QUIET,
    InputError,
    LayerNotes,
    Reporter,
    Text,
    UsageError,
    add_layer,
    card,
    in_language,
    iso_from_time,
    style_layers,
    tr,
    write_csv,
    zone_of,
)
from gis_radar.dataset import Dataset, LaneTraffic, open_dataset
from gis_radar.hdmap import LANES_LAYER
from gis_radar.measures import DRAWN, PRESUMED, TURN_WORDS
from gis_radar.products.datex import (
    publisher_of,
    write_datex_measurements,
    write_datex_sites,
)
from gis_radar.products.hand_counts import beside_hand_counts
from gis_radar.products.results_folder import write_results
from gis_radar.products.sumo import (
    as_edges,
    lanes_of_network,
    read_sumo_network,
    write_mean_data,
    write_turn_counts,
)
from gis_radar.products.traffic_picture import write_turning_diagram
from gis_radar.products.traffic_style import VOLUMES, traffic_style
from gis_radar.products.workbook import SHEET_ROWS, write_workbook

LANES, _TURNS, _SECTIONS, _CYCLES = "lanes", "turns", "sections", "cycles"
TITLES = {
    "lane": Text("Lane (id)"), "name": Text("Lane"),
    "section": Text("Section"), "direction": Text("Direction"), "place": Text("Section or lane"),
    "from_lane": Text("From lane (id)"), "to_lane": Text("To lane (id)"),
    "from_name": Text("From"), "to_name": Text("To"), "turn": Text("Turn"),
    "begin": Text("Begin"), "end": Text("End"),
    "visible_share": Text("Visible share [0-1]"), "counted": Text("Counted [veh]"),
    "volume": Text("Volume, estimated [veh]"), "volume_se": Text("Its standard error [veh]"),
    "volume_veh_h": Text("Volume [veh/h]"), "heavy": Text("Heavy among counted [veh]"),
    "speed_kmh": Text("Mean speed on the lane [km/h]"),
    "speed_time_mean_kmh": Text("Mean speed at the line [km/h]"),
    "speed_85_kmh": Text("85 % drive up to [km/h]"),
    "occupancy": Text("Occupancy [0-1]"),
    "occupancy_se": Text("Standard error of the occupancy [0-1]"),
    "density_veh_km": Text("Density [veh/km]"), "flow_veh_h": Text("Flow on the lane [veh/h]"),
    "travel_time_s": Text("Travel time [s]"), "delay_s": Text("Delay [s]"),
    "queue_max_m": Text("Longest queue [m]"), "queue_mean_m": Text("Mean queue [m]"),
    "sight_m": Text("In sight before the line [m]"),
    "stop_line": Text("Stop line"), "stops": Text("Stops [veh]"), "los": Text("Level of service"),
    "headways": Text("Headways [pairs]"), "headway_mean_s": Text("Mean headway [s]"),
    "headway_se_s": Text("Standard error of the mean headway [s]"),
    "headway_median_s": Text("Median headway [s]"), "gap_mean_s": Text("Mean gap [s]"),
    "gap_se_s": Text("Standard error of the mean gap [s]"),
    "cycle_s": Text("Cycle [s]"), "cycle_se_s": Text("Standard error of the cycle [s]"),
    "queue_end_m": Text("Queue at the end of green [m]"), "reason": Text("Why it is missing"),
    "volume_by_hand": Text("Counted by hand [veh]"),
    "difference": Text("Ours less theirs [veh]"), "geh": Text("GEH"),
    "agrees": Text("Within both errors"),
}  # fmt: skip
"""Titles of all columns, with units."""
_NOTES = (
    Text("Vehicles are counted while their fronts cross the stop line of a lane, elsewhere its "
         "middle. The visible share says for how much of the interval that line was visible."),
    Text("The volume is the estimate for the whole interval. It lies within its standard error of "
         "the truth in about two cases of three, within two of them in most others: this was "
         "measured up to 100 m from a radar, and farther away errors are larger."),
    Text("An empty field is not known, and no 0: too little was visible, or nobody drove there."),
    Text("Speeds, heavy vehicles, queues, stops and delays have no stated error."),
    Text("A queue that reaches as far as the road is in sight may be longer."),
    Text("Queues are measured from the stop line that the map has, 'drawn', else from a 'presumed' "
         "one: the end of the lane before a junction."),
    Text("Levels of service are those of a handbook for 15 minutes and more."),
    Text("The figures are of these times only: they say nothing about other hours or days, about "
         "the routes of vehicles, or why these wait."),
)  # fmt: skip
"""What a reader of the workbook may and may not conclude."""
_IDS = ("lane", "from_lane", "to_lane")  # up to 9e18: as numbers, xlsx and JSON would round them
_STOP_LINES = {DRAWN: Text("drawn"), PRESUMED: Text("presumed")}
_TIMES = ("begin", "end")
# What files of an earlier result begin with, also of one with other options.
_OWNED = ("traffic.", "turns.", f"{_SECTIONS}.", "hand_counts.", f"{_CYCLES}.", "sumo.", "datex.")
_DIGITS = 4  # of numbers in tables for people: far below their errors


@dataclass(frozen=True, kw_only=True, eq=False)
class Traffic:
    """Traffic of lanes and turns by intervals.

    Parameters
    ----------
    lanes, turns : GeoDataFrame
        From :meth:`gis_radar.Dataset.traffic` and :meth:`gis_radar.Dataset.turns`.
    whole_turns : GeoDataFrame, optional
        The turns over the whole time, for the turning diagram.
    sections : GeoDataFrame, optional
        From :meth:`gis_radar.Dataset.count_sections`.
    hand_counts : DataFrame, optional
        Counts by hand beside ours: `place`, `direction`, `begin`, `end`, `volume_by_hand`,
        `volume`, `volume_se`, `difference`, `geh`, `agrees` (within two standard errors of the
        difference; null where ours is missing).
    cycles : DataFrame, optional
        From :meth:`gis_radar.Dataset.signal_cycles`.
    sumo_edges : DataFrame, optional
        The edge of a network of SUMO, and the lane of it, on which each lane begins, is counted
        and ends: `place`, `lane`, `edge`, `sumo_lane`, `edge_lanes`, `as_long`, `counts`; by
        default each lane is an edge with its number.
    """

    lanes: gpd.GeoDataFrame
    turns: gpd.GeoDataFrame
    whole_turns: gpd.GeoDataFrame | None = None
    sections: gpd.GeoDataFrame | None = None
    hand_counts: pd.DataFrame | None = None
    cycles: pd.DataFrame | None = None
    sumo_edges: pd.DataFrame | None = None

    def figures(self) -> dict[str, Any]:
        """Return the numbers of lanes, turns and intervals, and the sums of the counts."""
        rows = self.lanes
        at_lines = rows.loc[rows["queue_max_m"].notna() & rows["stop_line"].eq(DRAWN), "counted"]
        figures: dict[str, Any] = {}
        if self.sections is not None:
            figures["sections"] = int(self.sections["section"].nunique())
        if self.hand_counts is not None:
            figures["hand_counts"] = len(self.hand_counts)
            figures["hand_counts_compared"] = int(self.hand_counts["agrees"].notna().sum())
            figures["hand_counts_that_agree"] = int(self.hand_counts["agrees"].eq(True).sum())
        if self.cycles is not None:
            figures["cycles"] = int(self.cycles["counted"].notna().sum())
        if self.sumo_edges is not None:
            figures["lanes_on_network"] = int(self.sumo_edges["place"].eq("line").sum())
        return figures | {
            "lanes": int(rows["lane"].nunique()),
            "turns": len(self.turns[["from_lane", "to_lane"]].drop_duplicates()),
            "intervals": int(rows["begin"].nunique()),
            "begin": iso_from_time(rows["begin"].min()),
            "end": iso_from_time(rows["end"].max()),
            "vehicles_at_stop_lines": None if at_lines.empty else int(at_lines.sum()),
            "rows_with_volume": int(rows["volume"].notna().sum()),
            "rows": len(rows),
        }

    def __repr__(self) -> str:
        known = self.figures()
        counts = ", ".join(f"{known[name]} {name}" for name in ("lanes", "turns", "intervals"))
        return f"Traffic({known['begin']} to {known['end']}: {counts})"

    def _repr_html_(self) -> str:
        return card("Traffic", self.figures())

    def write(
        self, folder: str | Path, *, datex: str | None = None, language: str | None = None,
        reporter: Reporter = QUIET,
    ) -> list[Path]:  # fmt: skip
        """Write all files into a folder, which appears whole or not at all.

        `traffic.csv` and `turns.csv`; `traffic.xlsx` with a sheet each; `traffic.gpkg` with the
        layers `lanes`, `turns` and, where there are, `sections`, which QGIS shows in our style;
        `sumo.edgedata.xml`, `sumo.lanedata.xml` and `sumo.turns.xml`, in which an edge is that of
        the network given, else a lane with its number; and where turns have volumes over the whole
        time `turns.png`, the turning diagram, with the figures of the report. Of sections
        `sections.csv`, of counts by hand `hand_counts.csv`, of cycles `cycles.csv`, and a sheet
        each; for DATEX II `datex.sites.xml`, the table of measurement sites, and
        `datex.measured.xml`.

        Parameters
        ----------
        folder : str or Path
            The folder; an earlier result there is replaced.
        datex : str, optional
            Publisher, country and name such as `DE:City of Example`, to write files for DATEX II
            version 3, too.
        language : str, optional
            Language of titles in sheets and layers, `en` or `de`; by default the current one.
        reporter : Reporter
            Receives warnings.

        Returns
        -------
        list of Path
            The files.

        Raises
        ------
        OutputError
            If the folder cannot be written, or holds other files.
        UsageError
            If the publisher is no country and name.
        """
        edges = self.sumo_edges
        if edges is None:
            ends = self.turns[["from_lane", "to_lane"]].to_numpy().ravel()
            edges = as_edges([*self.lanes["lane"], *ends])
        for_sumo = (self.lanes, edges, self.lanes["begin"].min())
        writers: dict[str, Callable[[Path], object]] = {
            "traffic.csv": partial(write_table, self.lanes),
            "turns.csv": partial(write_table, self.turns),
            **{
                f"{name}.csv": partial(write_table, table)
                for name, table in self._further_tables.items()
            },
            "traffic.xlsx": self._write_workbook,
            "traffic.gpkg": self._write_package,
            "sumo.edgedata.xml": partial(write_mean_data, *for_sumo, by_lane=False),
            "sumo.lanedata.xml": partial(write_mean_data, *for_sumo, by_lane=True),
            "sumo.turns.xml": partial(write_turn_counts, self.turns, *for_sumo[1:]),
        }
        if datex is not None:
            publisher = publisher_of(datex)
            writers["datex.sites.xml"] = partial(write_datex_sites, self.lanes, publisher)
            writers["datex.measured.xml"] = partial(write_datex_measurements, self.lanes, publisher)
        rows = max(map(len, (self.lanes, self.turns, *self._further_tables.values())))
        if rows > SHEET_ROWS:
            del writers["traffic.xlsx"]
            reporter.warn(
                "{} is left out: {} rows, and a sheet holds {}; the tables (CSV) have all",
                "traffic.xlsx",
                rows,
                SHEET_ROWS,
            )
        if self.whole_turns is not None and self.whole_turns["volume"].notna().any():
            writers["turns.png"] = partial(write_turning_diagram, self.lanes, self.whole_turns)
        return write_results(
            folder, writers, name="traffic", owned=_OWNED, stage="writing traffic",
            language=language, reporter=reporter,
        )  # fmt: skip

    @property
    def _further_tables(self) -> dict[str, pd.DataFrame]:
        tables = {_SECTIONS: self.sections, "hand_counts": self.hand_counts, _CYCLES: self.cycles}
        return {name: table for name, table in tables.items() if table is not None}

    def _write_workbook(self, path: Path) -> None:
        sheets = {tr("Lanes"): self.lanes, tr("Turns"): self.turns}
        names = {_SECTIONS: tr("Count sections"), "hand_counts": tr("Counts by hand"),
                 _CYCLES: tr("Cycles")}  # fmt: skip
        sheets |= {names[name]: table for name, table in self._further_tables.items()}
        shown_by_sheet = {}
        for sheet, table in sheets.items():
            zone = str(table["begin"].dt.tz)
            shown = _readable_table(table)
            if "turn" in shown:
                shown["turn"] = [tr(TURN_WORDS[each]) for each in shown["turn"]]
            if "stop_line" in shown:
                shown["stop_line"] = [tr(_STOP_LINES.get(each, "")) for each in shown["stop_line"]]
            for name in _TIMES:  # spreadsheets know no zones
                shown[name] = shown[name].dt.tz_localize(None)
            titles = {str(name): tr(TITLES[str(name)]) for name in shown}
            titles |= {name: f"{titles[name]} ({zone})" for name in _TIMES}
            shown_by_sheet[sheet] = shown.rename(columns=titles)
        title = tr("How to read these figures")
        shown_by_sheet[tr("Notes")] = pd.DataFrame({title: list(map(tr, _NOTES))})
        write_workbook(shown_by_sheet, path)

    def _write_package(self, path: Path) -> None:
        titles = {name: (tr(title), tr(title)) for name, title in TITLES.items()}
        layers = {LANES: self.lanes, _TURNS: self.turns}
        layers |= {} if self.sections is None else {_SECTIONS: self.sections}
        labels = json.dumps({"timezone": str(self.lanes["begin"].dt.tz)})  # the clock of QGIS
        for layer, table in layers.items():
            shown = table.assign(
                **{name: table[name].dt.tz_convert("UTC") for name in _TIMES},
            )
            metadata = {"shows": VOLUMES, "labels": labels}
            add_layer(shown, path, layer, geometry_type="LineString", layer_metadata=metadata)
        interval = (self.lanes["end"] - self.lanes["begin"]).min()
        seconds = interval.total_seconds()
        styles = {
            layer: traffic_style(
                seconds, {str(n): tr(TITLES[str(n)]) for n in table if n in TITLES}, layer
            )
            for layer, table in layers.items()
        }
        notes = {
            LANES: LayerNotes(tr("Lanes"), tr("Traffic of lanes by interval"), titles),
            _TURNS: LayerNotes(tr("Turns"), tr("Volumes of turns by interval"), titles),
            _SECTIONS: LayerNotes(tr("Count sections"), tr("Volumes by direction"), titles),
        }
        style_layers(
            path, styles, name="traffic", about="volumes by lane and turn",
            notes={name: notes[name] for name in layers},
        )  # fmt: skip


def make_traffic(
    dataset: Dataset | str | Path,
    *,
    interval: str = "15min",
    begin: Any = None,
    end: Any = None,
    sections: gpd.GeoDataFrame | str | Path | None = None,
    hand_counts: str | Path | None = None,
    headways: bool = False,
    cycles: bool = False,
    signals: str | Path | None = None,
    service: str | None = None,
    sumo_net: str | Path | None = None,
    language: str | None = None,
    reporter: Reporter = QUIET,
) -> Traffic:
    """Return the traffic of a dataset by lane and turn, and at sections.

    Parameters
    ----------
    dataset : Dataset, str or Path
        A dataset with vehicles, from :func:`gis_radar.open_dataset`, or its folder.
    interval, begin, end, language
        As for :meth:`gis_radar.Dataset.traffic`.
    sections : GeoDataFrame, str or Path, optional
        Lines across roads, as for :meth:`gis_radar.Dataset.count_sections`.
    hand_counts : str or Path, optional
        CSV of counts by hand, which are put beside ours: `section` and `direction`, or `lane` (its
        number or name); `begin`, `end`, without a zone by the clocks of the site; `volume`; where
        known `volume_se`, its standard error.
    headways : bool
        Add headways and gaps to the lanes.
    cycles : bool
        Tell the cycles of signals, as :meth:`gis_radar.Dataset.signal_cycles` does.
    signals : str or Path, optional
        CSV of green times, as for :meth:`gis_radar.Dataset.signal_cycles`, whose cycles are then
        returned.
    service : {"hcm"}, optional
        Add the column `los` to the lanes: the level of service by this handbook.
    sumo_net : str or Path, optional
        A network of SUMO with a projection (`.net.xml`): its edges and lanes, those under the
        counting lines of ours, are named in the files for SUMO.
    reporter : Reporter
        Receives a warning about each section that ends inside a lane.

    Raises
    ------
    InputError
        If vehicles were not looked for, or none of its lanes is observed in that time; if sections,
        counts by hand or the network are not what they should be.
    NoAnswerError
        If no lane lies on one of the network.
    UsageError
        If there is no such interval.
    """
    dataset = open_dataset(dataset)
    options = {"begin": begin, "end": end, "language": language}
    lanes = dataset.traffic(interval, headways=headways, **options)
    if lanes.empty:
        raise InputError(
            "{}: no lane is observed in that time",
            dataset.folder,
            hint="gis-radar dataset shows from when to when it was measured",
        )
    section_rows, counts = None, None
    if sections is not None:
        section_rows = dataset.count_sections(sections, interval, reporter=reporter, **options)
    if hand_counts is not None:
        zone = zone_of(dataset.timezone)
        with in_language(language):
            counts = beside_hand_counts(hand_counts, lanes, section_rows, zone)
    if service is not None:
        lanes.insert(lanes.columns.get_loc("stops") + 1, "los", service_levels(lanes, service))
    edges = None
    if sumo_net is not None:
        order = LaneTraffic.of(dataset).network
        edges = lanes_of_network(dataset.layer(LANES_LAYER), order, read_sumo_network(sumo_net))
    return Traffic(
        lanes=lanes, turns=dataset.turns(interval, **options), sumo_edges=edges,
        whole_turns=dataset.turns(whole=True, **options), sections=section_rows,
        hand_counts=counts,
        cycles=dataset.signal_cycles(signals=signals, **options) if cycles or signals else None,
    )  # fmt: skip


def _readable_table(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table without geometry: ids as text, numbers rounded."""
    shown = pd.DataFrame(table.drop(columns="geometry", errors="ignore"))
    for name in shown:
        if name in _IDS:
            shown[name] = shown[name].astype(str)
        elif pd.api.types.is_float_dtype(shown[name]):
            shown[name] = shown[name].astype(np.float64).round(_DIGITS)
    return shown


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write CSV: columns by their names, times by the clocks of the site with their offset.

    Parameters
    ----------
    table : DataFrame
        Table of traffic, with `begin` and `end`.
    path : Path
        The file.
    """
    shown = _readable_table(table)
    for name in _TIMES:
        shown[name] = [each.isoformat() for each in shown[name]]
    write_csv(path, shown)


HANDBOOKS = {
    "hcm": {"A": 10.0, "B": 20.0, "C": 35.0, "D": 55.0, "E": 80.0, "F": np.inf},
}
"""Longest mean delay (s a vehicle) of each level, at signals.

`hcm`: Highway Capacity Manual (TRB, 6th edition, 2016), signalized intersections.
"""


def service_levels(lanes: gpd.GeoDataFrame, handbook: str) -> pd.Series:
    """Return the levels of service of lanes with a stop line.

    Parameters
    ----------
    lanes : GeoDataFrame
        From :meth:`gis_radar.Dataset.traffic`.
    handbook : {"hcm"}
        Handbook with the thresholds.

    Returns
    -------
    Series
        Letters. Null without a stop line of the map or a delay, and where a queue reaches back
        beyond the lane: its delay is then not all of it.

    Raises
    ------
    UsageError
        If there is no such handbook.
    """
    if handbook not in HANDBOOKS:
        raise UsageError("service is {}, expected one of {}", repr(handbook), ", ".join(HANDBOOKS))
    limits = HANDBOOKS[handbook]
    delay = lanes["delay_s"].to_numpy(np.float64)
    level = np.array(list(limits), object)[
        np.searchsorted(list(limits.values()), np.nan_to_num(delay))
    ]
    inside = (lanes["queue_max_m"] <= lanes.length) & lanes["stop_line"].eq(DRAWN)
    levels = np.where(inside & np.isfinite(delay), level, None)
    return pd.Series(levels, lanes.index, dtype=object)
