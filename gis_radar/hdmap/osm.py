"""Read OpenStreetMap XML as Lanelet2 uses it, as a stream: nodes, ways and relations."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn
from xml.parsers import expat

import numpy as np

from gis_radar.base import Floats, InputError, Integers, Text

_NODE_TAGS = ("ele", "local_x", "local_y")
_LONGEST_TAG = 1 << 20  # bytes; the longest of a map are texts of some kilobytes
_DEEPEST = 100  # depth of nested elements; osm, relation and member make three
_BYTES_AT_ONCE = 1 << 18
_NOWHERE = (math.nan, math.nan)
_IDS = range(-(2**63), 2**63)
_WANTED = Text("a Lanelet2 map in OSM XML is needed")


class Member(NamedTuple):
    """One member of a relation: `kind` is node, way or relation."""

    kind: str
    ref: int
    role: str


@dataclass(frozen=True, kw_only=True)
class Way:
    """A line: the ids of its nodes in the order drawn, and its tags."""

    nodes: tuple[int, ...]
    tags: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Relation:
    """A group of nodes, ways and relations with roles, and its tags."""

    members: tuple[Member, ...]
    tags: dict[str, str]

    @property
    def type(self) -> str:
        """Its tag `type`: `lanelet`, `regulatory_element`, `multipolygon`, ..."""
        return self.tags.get("type", "")

    def refs(self, kind: str, role: str) -> tuple[int, ...]:
        """Return the ids of the members of one kind and role, in their order."""
        return tuple(m.ref for m in self.members if m.kind == kind and m.role == role)


@dataclass(frozen=True, kw_only=True)
class OsmMap:
    """The elements of an OSM file, not yet interpreted as lanelets.

    Parameters
    ----------
    path : Path
        The file, for messages.
    node_ids : (n,) array
        Node ids in the order of the file, each once.
    geographic : (n, 2) array
        Longitude and latitude in degrees (WGS84); NaN where missing or impossible.
    local : (n, 2) array
        The tags `local_x` and `local_y` in metres; NaN where missing.
    elevation : (n,) array
        The tag `ele` in metres; NaN where missing.
    ways, relations : dict
        Ways and relations by id.
    duplicates : tuple of (str, int)
        Kind and id of each element that is left out because an earlier one has its id.
    odd_heights : tuple of (int, str)
        Node and text of each tag `ele` that is neither empty nor a number.
    """

    path: Path
    node_ids: Integers
    geographic: Floats
    local: Floats
    elevation: Floats
    ways: dict[int, Way]
    relations: dict[int, Relation]
    duplicates: tuple[tuple[str, int], ...]
    odd_heights: tuple[tuple[int, str], ...] = ()

    @cached_property
    def node_index(self) -> dict[int, int]:
        """Row of each node id in the arrays."""
        return {int(node): row for row, node in enumerate(self.node_ids)}

    def relations_of(self, kind: str) -> Iterator[tuple[int, Relation]]:
        """Yield id and relation for every relation of one type."""
        return (
            (ref, relation) for ref, relation in self.relations.items() if relation.type == kind
        )


def map_digest(path: str | Path) -> str:
    """Return the BLAKE2b digest of a map's bytes, by which a dataset knows it."""
    return hashlib.blake2b(Path(path).read_bytes(), digest_size=16).hexdigest()


def read_osm(path: str | Path) -> OsmMap:
    """Read an OSM XML file.

    Document type definitions and entities are refused, and never expanded. Elements that an editor
    marked as deleted are left out.

    Parameters
    ----------
    path : str or Path
        An OSM 0.6 file, in any encoding that its first line declares.

    Returns
    -------
    OsmMap
        Nodes, ways and relations as they stand in the file.

    Raises
    ------
    InputError
        If the file cannot be read, is not XML, ends early, is not OSM, or holds a bad id.
    """
    collector = _Collector(Path(path))
    parser = expat.ParserCreate()
    collector.attach(parser)
    try:
        with Path(path).open("rb") as file:
            _parse(parser, file, collector)
    except OSError as error:
        raise InputError("{}: cannot be read: {}", path, error.strerror or error) from error
    except (expat.ExpatError, ValueError, LookupError) as error:
        reason = _not_xml(path, error, parser.CurrentLineNumber)
        raise InputError(reason, hint=_WANTED) from error
    return collector.finished()


def _parse(parser: expat.XMLParserType, file: BinaryIO, collector: _Collector) -> None:
    """Parse a file in batches: a tag without an end is refused before it fills the memory."""
    read = 0
    while batch := file.read(_BYTES_AT_ONCE):
        parser.Parse(batch)
        read += len(batch)
        # Expat keeps an unfinished tag and reads it from its begin again with each batch.
        if read - max(parser.CurrentByteIndex, 0) > _LONGEST_TAG + _BYTES_AT_ONCE:
            collector.refuse(Text("a tag of over {} MiB, a map has none", _LONGEST_TAG >> 20))
    parser.Parse(b"", True)


def _not_xml(path: str | Path, error: Exception, line: int) -> str:
    """Return why the parser gave up, for a user who may have named the wrong file."""
    reason = str(error).split(":")[0]
    if Path(path).stat().st_size == 0:
        return Text("{}: the file is empty", path)
    if reason in {"no element found", "unclosed token", "unclosed CDATA section"}:
        return Text("{}: line {}: the file ends early: truncated XML", path, line)
    return Text("{}: line {}: not XML: {}", path, line, reason)


class _Collector:
    """Collector of elements as the parser meets them; one node, way or relation is open."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[int, tuple[float, ...]] = {}
        self.ways: dict[int, Way] = {}
        self.relations: dict[int, Relation] = {}
        self.known: dict[str, dict[int, Any]] = {
            "node": self.rows,
            "way": self.ways,
            "relation": self.relations,
        }
        self.duplicates: list[tuple[str, int]] = []
        self.odd_heights: list[tuple[int, str]] = []
        self.depth = 0
        self._reset_element()

    def attach(self, parser: expat.XMLParserType) -> None:
        """Make the parser call this collector."""
        self.parser = parser
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        parser.EntityDeclHandler = self._refuse_doctype
        parser.buffer_text = True

    def finished(self) -> OsmMap:
        """Return the elements collected."""
        table = np.array(list(self.rows.values()), dtype=np.float64).reshape(-1, 5)
        return OsmMap(
            path=self.path,
            node_ids=np.fromiter(self.rows, dtype=np.int64, count=len(self.rows)),
            geographic=table[:, 0:2],
            local=table[:, 3:5],
            elevation=table[:, 2],
            ways=self.ways,
            relations=self.relations,
            duplicates=tuple(self.duplicates),
            odd_heights=tuple(self.odd_heights),
        )

    def _reset_element(self) -> None:
        self.place: tuple[float, float] = _NOWHERE
        self.refs: list[int] = []
        self.members: list[Member] = []
        self.tags: dict[str, str] = {}
        self.id = 0

    def refuse(self, reason: str) -> NoReturn:
        """Refuse the element at which the parser is."""
        raise InputError("{}: line {}: {}", self.path, self.parser.CurrentLineNumber, reason)

    def _refuse_doctype(self, *_: object) -> None:
        self.refuse("document types and entities are refused, a Lanelet2 map has none")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        """Take the begin of an element: open a node, way or relation, or add to the open one."""
        self.depth += 1
        if self.depth > _DEEPEST:
            self.refuse(Text("elements are nested {} deep, a map's are three", _DEEPEST))
        if self.depth == 1 and name != "osm":
            raise InputError(
                "{}: not OSM: its root is <{}>, expected <osm>", self.path, name, hint=_WANTED
            )
        if name == "tag":
            self.tags[attributes.get("k", "")] = attributes.get("v", "")
        elif name == "nd":
            self.refs.append(self._id(name, attributes.get("ref")))
        elif name == "member":
            ref = self._id(name, attributes.get("ref"))
            member = Member(attributes.get("type", ""), ref, attributes.get("role", ""))
            self.members.append(member)
        elif name in {"node", "way", "relation"}:
            self._open(name, attributes)

    def _open(self, name: str, attributes: dict[str, str]) -> None:
        self._reset_element()
        self.id = self._id(name, attributes.get("id"))
        self.deleted = attributes.get("action") == "delete" or attributes.get("visible") == "false"
        if name == "node":
            self.place = _place(attributes.get("lon", ""), attributes.get("lat", ""))

    def _end(self, name: str) -> None:
        """Take the end of an element: keep the node, way or relation unless its id was used."""
        self.depth -= 1
        if name not in {"node", "way", "relation"} or self.deleted:
            return
        known = self.known[name]
        if self.id in known:
            self.duplicates.append((name, self.id))
        elif name == "node":
            tags = self.tags
            extra = [_number(tags[key]) if key in tags else math.nan for key in _NODE_TAGS]
            self.rows[self.id] = (*self.place, *extra)
            if math.isnan(extra[0]) and tags.get("ele", "").strip().lower() not in {"", "nan"}:
                self.odd_heights.append((self.id, tags["ele"]))
        elif name == "way":
            self.ways[self.id] = Way(nodes=tuple(self.refs), tags=self.tags)
        else:
            self.relations[self.id] = Relation(members=tuple(self.members), tags=self.tags)

    def _id(self, name: str, text: str | None) -> int:
        """Return an id of 64 bits; refuse any other text."""
        try:
            number = int(text or "")
        except ValueError:
            number = _IDS.stop
        if number not in _IDS:
            raise InputError(
                "{}: line {}: <{}> has the id {}, expected an integer of 64 bits",
                self.path,
                self.parser.CurrentLineNumber,
                name,
                repr(text),
            )
        return number


def _place(longitude: str, latitude: str) -> tuple[float, float]:
    """Return longitude and latitude in degrees, NaN for both unless both are possible."""
    lon, lat = _number(longitude), _number(latitude)
    return (lon, lat) if abs(lon) <= 180.0 and abs(lat) <= 90.0 else _NOWHERE


def _number(text: str) -> float:
    """Return a finite number, or NaN for anything else."""
    try:
        number = float(text)
    except ValueError:
        return math.nan
    return number if math.isfinite(number) else math.nan
