"""Compare counts by hand with ours: differences, GEH, and agreement within their errors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd

from gis_radar.base import (
    LANGUAGES,
    InputError,
    Text,
    csv_rows,
    in_language,
    listed,
    stated_moment,
    text_in,
    tr,
)
from gis_radar.measures import BOUND_WORDS

_AGREE = 2.0  # standard errors of the difference within which two counts agree: 95 % of cases
_PLACES = ("section", "lane")
_NEEDED = ("begin", "end", "volume")
_THOUSANDS = re.compile(r"[1-9]\d{0,2}(\.\d{3})+")  # after commas were replaced by points


def beside_hand_counts(
    path: str | Path, lanes: pd.DataFrame, sections: pd.DataFrame | None, zone: ZoneInfo
) -> pd.DataFrame:
    """Put volumes that were counted by hand beside those of the radar.

    Parameters
    ----------
    path : str or Path
        CSV with a header: `section` (and `direction`, where a section has two) or `lane` (its
        number or name); `begin`, `end`, without a zone by the clocks of the site; `volume`; and,
        where known, `volume_se`, the standard error of the count by hand: 0 without it. As Excel
        writes it in Germany, too: semicolons, Windows-1252, times such as 12.06.2025 07:30.
    lanes, sections : DataFrame
        Our volumes by interval, from :meth:`gis_radar.Dataset.traffic` and
        :meth:`gis_radar.Dataset.count_sections`.
    zone : ZoneInfo
        Time zone of the site.

    Returns
    -------
    DataFrame
        The rows of the file: `place`, `direction`, `begin`, `end`, `volume_by_hand`, `volume`,
        `volume_se`, `difference` (ours less theirs), `geh` (of hourly volumes; Design Manual for
        Roads and Bridges, vol. 12), `agrees`. Ours is null where an interval was not measured.

    Raises
    ------
    InputError
        If the file is no such table, has an unknown lane or section, a time inside one of our
        intervals, or one count twice.
    """
    compared = []
    for number, row in _read(path):
        what = f"{path}, line {number}"
        place, ours = _our_volumes_at(row, lanes, sections, what)
        begin, end = (
            _moment(text_in(row, name), zone, f"{what}: {name}") for name in ("begin", "end")
        )
        ours_within = _within(ours, begin, end, what)
        hours = (end - begin).total_seconds() / 3600.0
        by_hand, by_hand_se = _number(row, "volume", what), _number(row, "volume_se", what, 0.0)
        volume = ours_within["volume"].astype(float).sum(min_count=max(len(ours_within), 1))
        spread = (
            ours_within["volume_se"].astype(float).pow(2).sum(min_count=max(len(ours_within), 1))
        )
        sum_h, difference_h = (volume + by_hand) / hours, (volume - by_hand) / hours
        compared.append({
            "place": place, "direction": _direction_of(row) or None, "begin": begin,
            "end": end, "volume_by_hand": by_hand, "volume": volume, "volume_se": np.sqrt(spread),
            "difference": volume - by_hand,
            "geh": np.sqrt(2.0 * difference_h**2 / sum_h) if sum_h else difference_h,
            "agrees": None if np.isnan(volume) else bool(
                abs(volume - by_hand) <= _AGREE * np.sqrt(spread + by_hand_se**2)
            ),
        })  # fmt: skip
    table = pd.DataFrame(compared)
    if (twice := table.duplicated(["place", "direction", "begin", "end"])).any():
        raise InputError(
            "{}: counts {} from {} twice", path, table["place"][twice].iloc[0],
            table["begin"][twice].iloc[0].isoformat(" ", "minutes"),
            hint="add up the classes of vehicles, and name each place and time once",
        )  # fmt: skip
    first, after = lanes["begin"].min(), lanes["end"].max()
    if not ((table["begin"] < after) & (table["end"] > first)).any():
        raise InputError(
            "{}: none of its counts is of the time that was measured, {} to {}",
            path, *(each.tz_convert(zone).isoformat(" ", "minutes") for each in (first, after)),
            hint="are they of another day, or by clocks of another time zone?",
        )  # fmt: skip
    return table


def _read(path: str | Path) -> list[tuple[int, dict[str, str]]]:
    """Return the rows that are not empty, each with its line number in the file."""
    header, rows = csv_rows(path, Text("not a table of counts"))
    missing = [name for name in _NEEDED if name not in header]
    if missing or not any(name in header for name in _PLACES):
        lacks = listed(missing) or Text("section or lane")
        hint = "columns are section or lane, direction, begin, end, volume"
        raise InputError("{}: lacks the columns {}", path, lacks, hint=Text(hint))
    if not rows:
        raise InputError("{}: holds no counts", path)
    return rows


def _number(row: Mapping[Any, Any], name: str, what: str, missing: float | None = None) -> float:
    text = text_in(row, name).replace(",", ".")
    if not text and missing is not None:
        return missing
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    in_thousands = name == "volume" and _THOUSANDS.fullmatch(text)  # may also be three decimals
    if in_thousands or not 0.0 <= value < np.inf:
        raise InputError(
            "{}: {} is {}, expected a number of vehicles", what, name, repr(text_in(row, name)),
            hint="write it without a separator of thousands" if in_thousands else "",
        )  # fmt: skip
    return value


def _moment(text: str, zone: ZoneInfo, what: str) -> pd.Timestamp:
    return pd.Timestamp(stated_moment(text, zone, what)).tz_convert(zone)


def _direction_of(row: Mapping[Any, Any]) -> str:
    """Return the direction of a count, written in any language, in the current one.

    The bare wind is understood, too: `north`, `Nord` and `Norden` as `northbound`.
    """
    direction = text_in(row, "direction")
    for language in LANGUAGES:
        with in_language(language):
            known = {tr(wind): word for wind, word in BOUND_WORDS.items()}
            known |= {tr(word).split()[-1]: word for word in BOUND_WORDS.values()}
            known |= {tr(word): word for word in BOUND_WORDS.values()}
        if direction in known:
            return tr(known[direction])
    return direction


def _our_volumes_at(
    row: Mapping[Any, Any], lanes: pd.DataFrame, sections: pd.DataFrame | None, what: str
) -> tuple[str, pd.DataFrame]:
    """Return the name of a counted place, and our rows of it."""
    section, lane = (text_in(row, name) for name in _PLACES)
    direction = _direction_of(row)
    if section:
        if sections is None:
            hint = "give the layer of sections, too"
            raise InputError("{}: section {} is not known", what, section, hint=hint)
        ours = sections[sections["section"] == section]
        names, directions = sorted(set(sections["section"])), sorted(set(ours["direction"]))
        if ours.empty:
            raise InputError(
                "{}: section is {}, expected one of {}", what, repr(section), ", ".join(names)
            )
        if direction not in directions and (direction or len(directions) > 1):
            expected = ", ".join(directions)
            raise InputError(
                "{}: direction is {}, expected one of {}", what, repr(direction), expected
            )
        return section, ours[ours["direction"] == direction] if direction else ours
    ours = lanes[(lanes["lane"].astype(str) == lane) | (lanes["name"] == lane)]
    if ours.empty:
        raise InputError(
            "{}: lane {} is none that was measured", what, repr(lane),
            hint="traffic.csv lists lanes with numbers and names",
        )  # fmt: skip
    return str(ours["name"].iloc[0]), ours


def _within(ours: pd.DataFrame, begin: pd.Timestamp, end: pd.Timestamp, what: str) -> pd.DataFrame:
    """Return our intervals from begin to end; none unless they cover it completely."""
    if begin >= end:
        raise InputError("{}: ends before it begins", what)
    overlapping = ours[((ours["begin"] < begin) & (ours["end"] > begin)) | (
        (ours["begin"] < end) & (ours["end"] > end)
    )]  # fmt: skip
    if len(overlapping):
        raise InputError(
            "{}: begins or ends within one of our intervals", what,
            hint="choose a shorter interval that fits",
        )  # fmt: skip
    inside = ours[(ours["begin"] >= begin) & (ours["end"] <= end)]
    is_covered = (inside["end"] - inside["begin"]).sum() == end - begin
    return inside if is_covered else inside.iloc[:0]
