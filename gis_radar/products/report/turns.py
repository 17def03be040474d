"""Turns in a report: a diagram of them, and a table of their volumes."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure as MplFigure
from PIL import Image, ImageChops

from gis_radar.base import FONTS, NO_FIGURE, by_number, plural, tr, with_error
from gis_radar.measures import TURN_WORDS
from gis_radar.products import report_files as names
from gis_radar.products.heatmap.picture import NARROW_IN, for_a_phone, image_of_figure, png
from gis_radar.products.report.content import (
    NOT_SEEN,
    TOO_LITTLE,
    Column,
    Figure,
    Table,
    number_column,
)
from gis_radar.products.report.results import ReportedTraffic
from gis_radar.products.traffic_picture import draw_turning_diagram

_WIDE_IN, _WIDE_DPI = 7.2, 150  # width of the diagram on a screen


def turning_diagram(traffic: ReportedTraffic) -> Figure:
    """Draw the turning diagram, for the page and for a phone."""
    drawn = [_turning_image(traffic, width_in) for width_in in (_WIDE_IN, NARROW_IN)]
    wide, narrow = (each.quantize(128, dither=Image.Dither.NONE) for each in drawn)
    return Figure(
        png=png(wide), narrow=png(for_a_phone(narrow)), width=wide.width, height=wide.height,
        caption=tr(
            "Vehicles an hour with their standard errors; an arrow is as wide as its volume, north "
            "is up. Vehicles that were not followed to an exit are shared among the turns like the "
            "others; a turn without an arrow was not seen; figures without room stand in the "
            "table."
        ),
        alt=tr("Turning diagram of the site; the table below has its figures."),
    )  # fmt: skip


def _turning_image(traffic: ReportedTraffic, width_in: float) -> Image.Image:
    wide = width_in > NARROW_IN
    with mpl.rc_context(FONTS):
        dpi = _WIDE_DPI if wide else 2 * _WIDE_DPI
        figure = MplFigure(figsize=(width_in, width_in), dpi=dpi, layout="constrained")
        known = traffic.by_turn[traffic.by_turn["volume"].notna()]
        known = known.assign(error_veh_h=known["volume_se"] / traffic.hours)
        draw_turning_diagram(figure, traffic.lanes, known, labels=wide)
        drawn = image_of_figure(figure).convert("RGB")
        return drawn.crop(ImageChops.invert(drawn).getbbox())


def turn_table(traffic: ReportedTraffic) -> Table:
    """Return the volumes of turns, a row a lane, a column a way."""
    table, hours = traffic.by_turn, traffic.hours
    directions = [way for way in TURN_WORDS if way in set(table["turn"])]
    numbers = table.groupby("from_lane")["from_name"].first()
    numbers = numbers.sort_values(key=lambda each: each.map(by_number))
    known = set(table.loc[table["volume"].notna(), "from_lane"])
    note = tr(
        "Turns of a lane sum to its volume where all of its exits were seen. No routes: where "
        "vehicles come from or go to beyond the junction is not known."
    )
    if unseen := len(numbers) - len(known):
        note += " " + plural(
            unseen, "{n} other lane has no turn that was seen.",
            "{n} other lanes have no turn that was seen.",
        )  # fmt: skip

    def volume(lane: int, way: str) -> str:
        mine = table[(table["from_lane"] == lane) & (table["turn"] == way)]
        if mine.empty:
            return NO_FIGURE
        unknown = mine[mine["volume"].isna()]
        if not unknown.empty:
            return tr(TOO_LITTLE if unknown["visible_share"].min() > 0.0 else NOT_SEEN)
        error = float(np.sqrt((mine["volume_se"] ** 2).sum()))
        return with_error(mine["volume"].sum() / hours, error / hours)

    titles = [Column(tr("From lane"), "", str, False), number_column(str)]
    words = [tr(TURN_WORDS[way]) for way in directions]
    titles += [Column(word[:1].upper() + word[1:], tr("veh/h"), str) for word in words]
    return Table(
        name="turns", caption=tr("Turns over the whole time"), columns=titles,
        rows=[
            [str(name), str(lane), *(volume(int(str(lane)), way) for way in directions)]
            for lane, name in numbers.items() if lane in known
        ],
        note=note,
        files=[(names.TURNS_FILE, tr("each turn in each interval"))],
    )  # fmt: skip
