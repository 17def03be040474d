"""Texts for users that keep their template and values: English until shown in a language."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from pathlib import PurePath
from typing import Any, Self

_TEXTS_MEMBER = "texts"  # the member of a JSON document that holds the templates of its texts
_HOLE = re.compile(r"\{(\d{0,2})(?::[+,]*(?:\.\d)?[dfge%]?)?\}")


class Text(str):
    """A finished English text that keeps the template and the values it was made of.

    It is a `str` everywhere: in files, in comparisons, between processes. `gis_radar.base.words.tr`
    translates the template and fills in the values again: numbers with a format as the language
    writes them, texts among the values translated.

    Parameters
    ----------
    template : str
        English, with a hole for each value, as `str.format` takes it; without values a text as it
        stands.
    *values
        Numbers, paths, words or other texts.

    Examples
    --------
    >>> Text("{}: {:,} rows", "R1.parquet", 12000)
    'R1.parquet: 12,000 rows'
    """

    __slots__ = ("template", "values")
    template: str
    values: tuple[Any, ...]

    def __new__(cls, template: str, /, *values: Any) -> Self:
        """Fill in the values; a finished text stays what it is."""
        self = super().__new__(cls, template.format(*values) if values else template)
        self.template, self.values = template, tuple(map(_plain_value, values))
        if isinstance(template, Text) and not values:
            self.template, self.values = template.template, template.values
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return Text, (self.template, *self.values)

    def __str__(self) -> str:
        return self  # of an error, too: `str(error)` keeps the template

    def join(self, parts: Iterable[str], /) -> Text:
        """Return texts as one, with this one between them; words in it are translated, too."""
        values = tuple(parts)
        if any(map(str.isalpha, self)):
            between = [each for part in values for each in (self, part)][1:]
            return Text("{}" * len(between), *between)
        return Text(str.__str__(self).join("{}" for _ in values), *values)

    @property
    def about(self) -> str:
        """What it is about: the first value where the template begins with a hole and a colon.

        Where the first value is a text about something, that.
        """
        if not self.values or not self.template.startswith("{}"):
            return ""
        first = self.values[0]
        within = first.about if isinstance(first, Text) else ""
        return within or (str(first) if self.template.startswith("{}: ") else "")

    def without(self, name: str) -> Text:
        """Return the text without what it is about, if that is `name`."""
        if not name or self.about != name:
            return self
        first, *others = self.values
        if isinstance(first, Text) and first.about == name:
            rest = first.without(name)
            return rest if self.template == "{}" else Text(self.template, rest, *others)
        return Text(self.template.removeprefix("{}: "), *others)

    def names(self, name: str) -> bool:
        """Return whether a name is one of the values, or one of those of texts among them."""
        return any(
            each == name or (isinstance(each, Text) and each.names(name)) for each in self.values
        )


def _plain_value(value: Any) -> Any:
    """Return a value in a type that can be sent to other processes and written to files."""
    if isinstance(value, str | int | float | PurePath):
        return value
    if isinstance(value, Real):  # NumPy's
        return int(value) if isinstance(value, Integral) else float(value)
    return str(value)


def with_texts(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document for JSON with templates and values of its texts beside them."""
    templates: dict[str, Any] = {}
    _collect_templates(document, templates)
    return {**document, _TEXTS_MEMBER: templates} if templates else dict(document)


def _collect_templates(value: Any, templates: dict[str, Any]) -> None:
    """Add template and values of each text within a value, by the finished text."""
    if isinstance(value, Text) and value.values:
        templates[value] = _as_json(value)
    inner = value.values() if isinstance(value, Mapping) else value
    for each in inner if isinstance(value, Mapping | list | tuple) else ():
        _collect_templates(each, templates)


def _as_json(value: Any) -> Any:
    """Return a value as JSON holds it; a text as a list of template and values."""
    if isinstance(value, Text):
        return [value.template, *map(_as_json, value.values)]
    if isinstance(value, float):  # last digits vary with the order of sums; equal runs, equal bytes
        return float(f"{value:.9g}")
    return str(value) if isinstance(value, PurePath) else value


def restored(document: dict[str, Any]) -> dict[str, Any]:
    """Return a document of :func:`with_texts` with its strings as texts again, where they fit."""
    entries = document.pop(_TEXTS_MEMBER, None)
    texts = map(_from_json, entries.values()) if isinstance(entries, dict) else ()
    with_templates: dict[str, Any] = _replaced(document, {text: text for text in texts})
    return with_templates


def _from_json(entry: Any) -> Any:
    """Return the text of a list of :func:`_as_json`; anything else as a plain value."""
    match entry:
        case [str(template), *values]:
            if not values or _takes(template, len(values)):
                return Text(template, *map(_from_json, values))
    return str(entry) if isinstance(entry, list | dict) else entry


def _takes(template: str, count: int) -> bool:
    """Return whether a template takes so many values, and has plain holes only.

    The file may be anybody's: a hole could read a value's attributes, or ask for a huge width.
    """
    numbers = _HOLE.findall(template)
    places = range(len(numbers)) if not any(numbers) else [int(each or count) for each in numbers]
    rest = _HOLE.sub("", template.replace("{{", "").replace("}}", ""))
    return all(place < count for place in places) and not {"{", "}"} & set(rest)


def _replaced(value: Any, texts: Mapping[Any, Any]) -> Any:
    """Return a value of a JSON document with its strings replaced by equal texts."""
    if isinstance(value, str):
        return texts.get(value, value)
    if isinstance(value, dict):
        return {name: _replaced(each, texts) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_replaced(each, texts) for each in value]
    return value
