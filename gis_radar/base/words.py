"""Words, numbers and days in the current language, that of what is being written."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import datetime
from string import Formatter
from typing import Any

from gis_radar.base.errors import UsageError
from gis_radar.base.languages import LANGUAGES, catalogue
from gis_radar.base.texts import Text

NO_FIGURE, MINUS = "\u2013", "\u2212"  # a dash; a minus as wide as a plus
THIN_SPACE = "\u202f"  # narrow, and no line ends there
WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
_MONTHS = (
    "January", "February", "March", "April", "May", "June", "July", "August", "September",
    "October", "November", "December",
)  # fmt: skip
_WEEKDAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
# A context variable: what writes a number is ten calls below what is given the language.
_CURRENT: ContextVar[str] = ContextVar("language", default="en")


@contextmanager
def in_language(language: str | None) -> Iterator[None]:
    """Set the language of texts, numbers and days within the block; without one, it stays.

    Raises
    ------
    UsageError
        If there is no such language.
    """
    token = _CURRENT.set(known_language(language or _CURRENT.get()))
    try:
        yield
    finally:
        _CURRENT.reset(token)


def set_language(language: str) -> None:
    """Set the language of texts, numbers and days for the whole process."""
    _CURRENT.set(known_language(language))


def known_language(language: str) -> str:
    """Return a language; refuse one that has no catalogue."""
    if language not in LANGUAGES:
        known = Text("known are {}", ", ".join(LANGUAGES))
        raise UsageError("there is no language {}", repr(language), hint=known)
    return language


def current_language() -> str:
    """Return the language of what is written now, as two letters."""
    return _CURRENT.get()


def tr(text: str, /, **values: object) -> str:
    """Return a text in the current language, filled with its own values or those given."""
    known = catalogue(_CURRENT.get())
    if isinstance(text, Text) and text.values and known:
        return _Translator().format(known.get(text.template, text.template), *text.values)
    found = known.get(text, text)
    return found.format(**values) if values else str.__str__(found)


class _Translator(Formatter):
    """A formatter that writes values as the current language does."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a number with the language's signs, a text (also of several words) translated."""
        if isinstance(value, Text) or (isinstance(value, str) and " " in value):
            return tr(value)
        text = format(value, format_spec)
        if isinstance(value, float) or (isinstance(value, int) and format_spec):
            return decimal(text.replace(",", THIN_SPACE).replace("%", f"{THIN_SPACE}%"))
        return text


def plural(amount: int, one: str, many: str) -> str:
    """Return an amount with its noun, by one of two texts with a hole `{n}`."""
    return tr(one if amount == 1 else many, n=figure_text(amount))


def decimal(text: str) -> str:
    """Return a number with points and commas with the signs of the current language."""
    german = _CURRENT.get() == "de"
    return text.replace(",", THIN_SPACE).replace(".", ",") if german else text


def figure_text(value: float, digits: int = 0) -> str:
    """Return a number with thousands set apart; a dash where there is none."""
    if not math.isfinite(value):
        return NO_FIGURE
    text = decimal(f"{value:,.{digits}f}".replace(",", THIN_SPACE))
    return text.replace("-", MINUS) if float(f"{value:.{digits}f}") else text.replace("-", "")


def percent(share: float, digits: int = 1, *, error: float = math.nan) -> str:
    """Return a share as percent, with its standard error where there is one.

    A share over 0 is never written as 0.
    """
    if math.isfinite(share) and math.isfinite(error):
        value, spread = (figure_text(100 * each, digits) for each in (share, error))
        return f"{value}{THIN_SPACE}±{THIN_SPACE}{spread}{THIN_SPACE}%"
    if math.isfinite(share) and 0.0 < share * 100 < 0.5 * 10.0**-digits:
        return tr("under {value}", value=decimal(f"{10.0**-digits:g}{THIN_SPACE}%"))
    return f"{figure_text(share * 100, digits)}{THIN_SPACE}%" if math.isfinite(share) else NO_FIGURE


def plus_minus(value: float, digits: int, unit: str = "") -> str:
    """Return one standard deviation with its sign and unit; a dash where it is not known."""
    text = f"±{THIN_SPACE}{figure_text(value, digits)}{unit.replace(' ', THIN_SPACE)}"
    return text if math.isfinite(value) else NO_FIGURE


def with_error(value: float, error: float) -> str:
    """Return a value with its standard error; 0 alone where neither is half a unit.

    Examples
    --------
    >>> with_error(120.0, 11.2).replace(THIN_SPACE, " "), with_error(0.0, 0.0)
    ('120 ± 11', '0')
    """
    shown = figure_text(value), figure_text(error)
    return "0" if shown == ("0", "0") else f"{THIN_SPACE}±{THIN_SPACE}".join(shown)


def by_number(name: str) -> str:
    """Return a name by which names sort so that numbers in them ascend.

    Examples
    --------
    >>> sorted(["lane 10", "lane 2"], key=by_number)
    ['lane 2', 'lane 10']
    """
    return re.sub(r"[0-9]+", lambda digits: digits[0].zfill(9), name)


def wind_of(east_m: float, north_m: float) -> str:
    """Return the wind of `WINDS`, from grid north, that a vector points to; empty for none."""
    if math.hypot(east_m, north_m) < 1e-6:
        return ""
    return WINDS[round(math.atan2(east_m, north_m) / (math.pi / 4)) % 8]


def direction(east_m: float, north_m: float) -> str:
    """Return the wind of :func:`wind_of` in the reader's language; a dash where there is none."""
    return tr(wind_of(east_m, north_m) or NO_FIGURE)


def street_label(street: object, part: object = None) -> str:
    """Return a street's name, with its part where several streets share it; empty if unknown.

    Examples
    --------
    >>> street_label("Ring", "north-east")
    'Ring (north-east)'
    """
    if not (isinstance(street, str) and street):
        return ""
    return f"{street} ({tr(part)})" if isinstance(part, str) and part else street


def listed(words: Sequence[str]) -> str:
    """Return words as a list in a sentence."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {tr('and')} {words[-1]}"


def seconds_text(seconds: float) -> str:
    """Return a duration in its two largest units: `100 s`, `23 h 45 min`."""
    left = round(seconds)
    parts: list[tuple[int, str]] = []
    if left < 120:
        return f"{figure_text(seconds, 0 if seconds >= 10 else 1)}{THIN_SPACE}s"
    for unit, size_s in (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1)):
        amount, left = divmod(left, size_s)
        if amount or parts:
            parts.append((amount, unit))
    return " ".join(f"{amount}{THIN_SPACE}{unit}" for amount, unit in parts[:2] if amount)


def long_day(moment: datetime) -> str:
    """Return a day with its month's name: `12 June 2025`."""
    month, dot = tr(_MONTHS[moment.month - 1]), "." if _CURRENT.get() == "de" else ""
    return f"{moment.day}{dot} {month} {moment.year}"


def short_day(moment: datetime) -> str:
    """Return a day in figures."""
    return f"{moment:%d.%m.%Y}" if _CURRENT.get() == "de" else f"{moment:%Y-%m-%d}"


def weekday(moment: datetime) -> str:
    """Return the day of the week, short."""
    return tr(_WEEKDAYS[moment.weekday()])
