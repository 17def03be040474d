"""Words, numbers and days in the language of who reads: of what is written at the moment."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from itertools import count

from gis_radar.errors import UsageError
from gis_radar.languages import LANGUAGES, catalogue, messages
from gis_radar.languages.site_keys import keys_for_options

NOTHING, MINUS = "\u2013", "\u2212"  # a dash; a minus as wide as a plus
THIN = "\u202f"  # narrow, and no line ends there
WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
_MONTHS = (
    "January", "February", "March", "April", "May", "June", "July", "August", "September",
    "October", "November", "December",
)  # fmt: skip
_WEEKDAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_HOLE = re.compile(r"\{\w*\}")
# What stands before a message and is no name of a file or a sensor: verdicts, and stages of a run,
# which begin so.
_VERDICTS = frozenset({"confirms", "doubts", "alone", "refused"})
_STAGES = frozenset({
    "road", "mask", "convert", "localize", "poses", "pose", "tiles", "measure",
    "heat", "QGIS", "report",
})  # fmt: skip

# Not an argument of each function: what writes a number is ten calls below who knows the language.
_CURRENT: ContextVar[str] = ContextVar("language", default="en")


@contextmanager
def speaking(language: str) -> Iterator[None]:
    """Set the language of texts, numbers and days within the block.

    Raises
    ------
    UsageError
        If there is no such language.
    """
    token = _CURRENT.set(known_language(language))
    try:
        yield
    finally:
        _CURRENT.reset(token)


def speak(language: str) -> None:
    """Set the language of texts, numbers and days for the whole process."""
    _CURRENT.set(known_language(language))


def known_language(language: str) -> str:
    """Return a language; refuse one that there are no words of."""
    if language not in LANGUAGES:
        raise UsageError(
            f"there is no language {language!r}", hint=f"known are {', '.join(LANGUAGES)}"
        )
    return language


def current_language() -> str:
    """Return the language of what is written now, as two letters."""
    return _CURRENT.get()


def tr(text: str, /, **values: object) -> str:
    """Return a text in the current language, with values in its holes."""
    found = catalogue(_CURRENT.get()).get(text, text)
    return found.format(**values) if values else found


def plural(amount: int, one: str, many: str) -> str:
    """Return an amount with its noun: texts with a hole `{n}`."""
    return tr(one if amount == 1 else many, n=figure_text(amount))


def tr_message(text: str) -> str:
    """Return a finished message in the current language, its values taken over.

    The messages of all rooms are English; those with holes in the catalogues are known again by
    what stands between their values. What stands before a colon may be the name of a file, a stage
    or a sensor; several messages are joined by semicolons.
    """
    if not messages(_CURRENT.get()):
        return text
    parts = text.split("; ")
    if len(parts) > 1:
        if found := _after_names(text, most=len(parts) - 1):
            return found
        if all(translated := [_after_names(each) for each in parts]):
            return "; ".join(translated)
    return _after_names(text) or text


def _after_names(text: str, *, most: int = 0) -> str:
    """Return a message in the current language, names before it kept; nothing if not known.

    With `most` only one that has so many semicolons of its own.
    """
    head, rest = "", text
    while not (found := _known(rest, most)) and ": " in rest:
        before, _, rest = rest.partition(": ")
        head += f"{_before(before)}: "
    return head + found if found else ""


def _before(text: str) -> str:
    """Return what stands before a message in the current language; a name as it is."""
    known = catalogue(_CURRENT.get())
    words = text.split(" ")
    if words[0].rstrip(",") in _STAGES:
        return ", ".join(map(stage_words, text.split(", ")))
    return known.get(text, text) if len(words) > 1 or text in _VERDICTS else text


def stage_words(stage: str) -> str:
    """Return a stage of a run in the current language: `localize R1` has a name in it."""
    known, words = catalogue(_CURRENT.get()), stage.split(" ")
    for most in range(len(words), 0, -1):
        if work := known.get(" ".join(words[:most])):
            return " ".join([work, *words[most:]])
    return stage


def _known(text: str, semicolons: int = 0) -> str:
    language = _CURRENT.get()
    if exact := _messages(language).get(text) or catalogue(language).get(text):
        return exact
    for each in _with_holes(language):
        values = each.values_in(text) if each.text.count("; ") >= semicolons else []
        if values and (each.sure or all(map(_is_ours, values))):
            return each.filled(values)
    return ""


def _is_ours(value: str) -> bool:
    return " " not in value or bool(_after_names(value))


@dataclass(frozen=True)
class _Message:
    """A message with holes, and its translation."""

    text: str
    translation: str

    @property
    def sure(self) -> bool:
        """Whether it is known by its words: `{} and {}` is part of many sentences."""
        whole = self.text[0] == "{" and self.text[-1] == "}"
        return not whole or _own_letters(self.text) >= _LEAST_LETTERS

    def values_in(self, text: str) -> list[str]:
        """Return the values in a finished message; none if it is another."""
        first, *between, last = _HOLE.split(self.text)
        # Cheap and sure: few of hundreds are compiled.
        if not (text.startswith(first) and text.endswith(last) and all(p in text for p in between)):
            return []
        match = _pattern(self.text).fullmatch(text)
        if not match or (not first and ": " in match[1]):  # a name before it is none of its values
            return []
        return list(match.groups())

    def filled(self, values: list[str]) -> str:
        """Return the translation with values in its holes."""
        names = [hole[1:-1] or str(place) for place, hole in enumerate(_HOLE.findall(self.text))]
        known = dict(zip(names, map(_own_value, values), strict=True))
        return _HOLE.sub(
            lambda hole: _figure(known[hole[0][1:-1]], self.translation[hole.end() :]),
            self.translation,
        )


@cache
def _pattern(text: str) -> re.Pattern[str]:
    return re.compile("(.*?)".join(map(re.escape, _HOLE.split(text))), re.DOTALL)


@cache
def _messages(language: str) -> dict[str, str]:
    """Return the messages with their translations, also those in the words of the site file."""
    known = messages(language)
    # Holes are numbered first: a key may stand before a value that its option stands behind.
    numbered = {_numbered(text): found for text, found in known.items()}
    in_keys = {keys_for_options(text): keys_for_options(numbered[text]) for text in numbered}
    return {text: in_keys[text] for text in in_keys.keys() - numbered.keys()} | known


def _numbered(text: str) -> str:
    numbers = count()
    return re.sub(r"\{\}", lambda _: f"{{{next(numbers)}}}", text)


@cache
def _with_holes(language: str) -> list[_Message]:
    """Return the messages with holes, those with the most letters of their own first."""
    told = [(text, found) for text, found in _messages(language).items() if _HOLE.search(text)]
    told += [
        (text, found) for text, found in catalogue(language).items()
        if _HOLE.search(text) and _own_letters(text) >= _LEAST_LETTERS
    ]  # fmt: skip
    return [_Message(*each) for each in sorted(told, key=lambda each: -_own_letters(each[0]))]


_LEAST_LETTERS = 8  # a text that is no message and has fewer of its own would be seen in others


def _own_letters(text: str) -> int:
    return len(re.sub(r"\{\w*\}|[^A-Za-z]", "", text))


def _own_value(value: str) -> str:
    """Return a value in the current language: a word of its own is a name, unless a direction."""
    return tr_message(value) if " " in value or value in WINDS else value


def _figure(value: str, after: str) -> str:
    """Return a value as numbers are written, where a unit comes after it or it is a share."""
    if re.fullmatch(r"-?\d+(\.\d+)?%", value):
        return decimal(f"{value[:-1]}{THIN}%")
    if re.fullmatch(r"[+-]?\d{1,3}(,\d{3})+", value):
        return value.replace(",", THIN)
    measured = re.match(r" (%|m|km|ms|s|h|Grad|ppm|MiB)\b| %", after)
    return decimal(value) if measured and re.fullmatch(r"-?\d+\.\d+", value) else value


def decimal(text: str) -> str:
    """Return a number that has a point with the decimal sign of the current language."""
    return text.replace(".", ",") if _CURRENT.get() == "de" else text


def figure_text(value: float, digits: int = 0) -> str:
    """Return a number with thousands set apart; a dash where there is none."""
    if not math.isfinite(value):
        return NOTHING
    text = decimal(f"{value:,.{digits}f}".replace(",", THIN))
    return text.replace("-", MINUS) if float(f"{value:.{digits}f}") else text.replace("-", "")


def percent(share: float, digits: int = 1, *, off: float = math.nan) -> str:
    """Return a share as percent, with its standard error where there is one.

    What is more than nothing never reads as nothing.
    """
    if math.isfinite(share) and math.isfinite(off):
        value, error = (figure_text(100 * each, digits) for each in (share, off))
        return f"{value}{THIN}±{THIN}{error}{THIN}%"
    if math.isfinite(share) and 0.0 < share * 100 < 0.5 * 10.0**-digits:
        return tr("under {value}", value=decimal(f"{10.0**-digits:g}{THIN}%"))
    return f"{figure_text(share * 100, digits)}{THIN}%" if math.isfinite(share) else NOTHING


def plus_minus(value: float, digits: int, unit: str = "") -> str:
    """Return one standard deviation; a dash where it is not known."""
    text = f"±{THIN}{figure_text(value, digits)}{unit.replace(' ', THIN)}"
    return text if math.isfinite(value) else NOTHING


def wind_of(east_m: float, north_m: float) -> str:
    """Return to which of eight winds of the map's grid a way leads; nothing where it has none."""
    if math.hypot(east_m, north_m) < 1e-6:
        return ""
    return WINDS[round(math.atan2(east_m, north_m) / (math.pi / 4)) % 8]


def direction(east_m: float, north_m: float) -> str:
    """Return the wind of :func:`wind_of` in the reader's language; a dash where there is none."""
    return tr(wind_of(east_m, north_m) or NOTHING)


def street_label(street: object, part: object = None) -> str:
    """Return how a street is called, with its place where several have its name; empty if unknown.

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
        return f"{figure_text(seconds, 0 if seconds >= 10 else 1)}{THIN}s"
    for unit, size_s in (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1)):
        amount, left = divmod(left, size_s)
        if amount or parts:
            parts.append((amount, unit))
    return " ".join(f"{amount}{THIN}{unit}" for amount, unit in parts[:2] if amount)


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
