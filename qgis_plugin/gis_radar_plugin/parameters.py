"""Parameters: what a dialog asks for, and the option of the worker's command that it becomes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsCsException,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterField,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterPoint,
    QgsProcessingParameterRange,
    QgsProcessingParameterString,
    QgsProcessingParameterVectorDestination,
)

from .inputs import layer_file
from .words import WINDS, speaks_german, tr

WEB_MERCATOR = "EPSG:3857"  # metric, and of the whole world
_REAL = QgsProcessingParameterNumber.Type.Double


@dataclass(frozen=True)
class Given:
    """The values that an algorithm was given."""

    algorithm: QgsProcessingAlgorithm
    parameters: dict[str, Any]
    context: QgsProcessingContext
    feedback: QgsProcessingFeedback
    outputs: dict[str, str] = field(default_factory=dict)  # by name, each asked for once

    def has(self, name: str) -> bool:
        """Return whether a parameter has a value of its own."""
        return self.parameters.get(name) not in (None, "")

    def text(self, name: str) -> str:
        """Return a text, or a file or folder to read."""
        text = self.algorithm.parameterAsString(self.parameters, name, self.context)
        return str(text).strip()

    def files(self, name: str) -> list[str]:
        """Return files; QGIS gives one without a name where there are none."""
        paths = self.algorithm.parameterAsFileList(self.parameters, name, self.context)
        return [str(path) for path in paths if path]

    def first(self, name: str) -> str:
        """Return the first of several texts, such as the name of a field."""
        texts = self.algorithm.parameterAsStrings(self.parameters, name, self.context)
        return str(texts[0]) if texts else ""

    def place(self, name: str) -> int:
        """Return which of the labels of a choice was chosen."""
        return int(self.algorithm.parameterAsEnum(self.parameters, name, self.context))

    def chosen(self, name: str) -> str:
        """Return which of the words of a choice was chosen."""
        known = self.parameters, name, self.context
        return str(self.algorithm.parameterAsEnumString(*known))

    def number(self, name: str) -> float:
        """Return a number."""
        return float(self.algorithm.parameterAsDouble(self.parameters, name, self.context))

    def is_on(self, name: str) -> bool:
        """Return whether a switch is on."""
        return bool(self.algorithm.parameterAsBoolean(self.parameters, name, self.context))

    def is_loaded(self, name: str) -> bool:
        """Return whether QGIS loads an output into the project."""
        return bool(self.context.willLoadLayerOnCompletion(self.outputs[name]))


@dataclass(frozen=True)
class Parameter:
    """A parameter; children define its kind, and the words that it becomes.

    Parameters
    ----------
    name, title, about : str
        Its name in scripts, its label, and its help.
    flag : str or None
        The worker's option; by default `--` and the name, empty for a word without one, None for
        what is not the worker's.
    optional, advanced : bool
        Whether it may be empty, and whether it is in the folded part of the dialog.
    """

    QGIS: ClassVar[Any] = QgsProcessingParameterString
    name: str
    title: str
    about: str = ""
    flag: str | None = "--"
    optional: bool = False
    advanced: bool = False

    def more(self) -> tuple[Any, ...]:
        """Return what QGIS's class takes beside name and label."""
        return ()

    def words(self, given: Given) -> list[str]:
        """Return the words of the worker's command line."""
        return self._option(given.text(self.name))

    def add_to(self, algorithm: Any) -> None:
        """Add it to an algorithm, in the language of QGIS."""
        definition = self.QGIS(self.name, tr(self.title), *self.more())
        definition.setHelp(tr(self.about))
        kinds, flags = QgsProcessingParameterDefinition.Flag, definition.flags()
        flags = flags | kinds.FlagOptional if self.optional else flags
        definition.setFlags(flags | kinds.FlagAdvanced if self.advanced else flags)
        algorithm.addParameter(definition)

    @property
    def option(self) -> str:
        """The worker's option."""
        name = self.name.lower().replace("_", "-")
        return f"--{name}" if self.flag == "--" else self.flag or ""

    def _option(self, *values: str) -> list[str]:
        words = [word for value in values if value for word in (self.option, value) if word]
        return words if self.flag is not None else []


@dataclass(frozen=True)
class Text(Parameter):
    """A text, as a rule an option among the further ones."""

    optional: bool = True
    advanced: bool = True
    default: str = ""

    def more(self) -> tuple[Any, ...]:
        return (tr(self.default) or None,)


@dataclass(frozen=True)
class Names(Text):
    """Several names, with a comma or a space between them."""

    def words(self, given: Given) -> list[str]:
        names = given.text(self.name).replace(",", " ").split()
        return self._option(*dict.fromkeys(names))


@dataclass(frozen=True)
class Bearing(Text):
    """A compass bearing: degrees, or a word of the user's language."""

    def words(self, given: Given) -> list[str]:
        return self._option(bearing_word(given.text(self.name)))


def bearing_word(text: str) -> str:
    """Return a bearing as the worker reads it: a number, or an English word of `WINDS`."""
    plain = text.strip().casefold().replace("-", "").replace(" ", "")
    for wind in WINDS:
        if plain in (tr(wind).casefold().replace("-", ""), wind.replace("-", "")):
            return wind
    return text.strip().replace(",", ".")


@dataclass(frozen=True)
class File(Parameter):
    """A file of some kinds, such as `Clocks (*.json)`."""

    QGIS = QgsProcessingParameterFile
    kinds: str = ""

    def more(self) -> tuple[Any, ...]:
        behaviour, ending = QgsProcessingParameterFile.Behavior.File, ""
        return behaviour, ending, None, self.optional, _file_filter(self.kinds)


@dataclass(frozen=True)
class Folder(Parameter):
    """A folder."""

    QGIS = QgsProcessingParameterFile

    def more(self) -> tuple[Any, ...]:
        return (QgsProcessingParameterFile.Behavior.Folder,)


def _file_filter(kinds: str) -> str:
    """Return kinds of files with their words in the user's language."""
    parts = [kind.partition(" (") for kind in kinds.split(";;") if kind]
    return ";;".join(f"{tr(words)} ({ends}" for words, _, ends in parts)


@dataclass(frozen=True)
class Files(Parameter):
    """Several files."""

    QGIS = QgsProcessingParameterMultipleLayers
    source: Any = QgsProcessing.SourceType.TypeFile

    def more(self) -> tuple[Any, ...]:
        return (self.source,)

    def words(self, given: Given) -> list[str]:
        return self._option(*given.files(self.name))


@dataclass(frozen=True)
class Layers(Files):
    """Several layers of the project."""

    source: Any = QgsProcessing.SourceType.TypeMapLayer


@dataclass(frozen=True)
class Number(Parameter):
    """A number; an option without a default may be empty: the command's own default holds."""

    QGIS = QgsProcessingParameterNumber
    optional: bool = True
    advanced: bool = True
    default: float | None = None
    limits: tuple[float, ...] = ()  # the least, or both

    def more(self) -> tuple[Any, ...]:
        return _REAL, self.default, self.optional, *self.limits

    def words(self, given: Given) -> list[str]:
        known = given.has(self.name) or self.default is not None
        return self._option(f"{given.number(self.name):.12g}" if known else "")


@dataclass(frozen=True)
class Range(Parameter):
    """The limits of a height."""

    QGIS = QgsProcessingParameterRange

    def more(self) -> tuple[Any, ...]:
        return (_REAL,)

    def words(self, given: Given) -> list[str]:
        """Return both limits with a comma between them.

        Raises
        ------
        QgsProcessingException
            If one is missing, or they are the wrong way round.
        """
        if given.parameters.get(self.name) in (None, "", "None,None"):
            return []
        low, high = given.algorithm.parameterAsRange(given.parameters, self.name, given.context)
        if not low < high:  # also where QGIS gives NaN for an empty box
            raise QgsProcessingException(
                tr("Height over the road: give both limits, the lower one first.")
            )
        return self._option(f"{low},{high}")


@dataclass(frozen=True)
class Switch(Parameter):
    """A switch among the further options."""

    QGIS = QgsProcessingParameterBoolean
    advanced: bool = True
    default: bool = False

    def more(self) -> tuple[Any, ...]:
        return (self.default,)

    def words(self, given: Given) -> list[str]:
        return [self.option] if self.option and given.is_on(self.name) else []


@dataclass(frozen=True)
class Choice(Parameter):
    """One of some words; the first is the command's default, and not given."""

    QGIS = QgsProcessingParameterEnum
    advanced: bool = True
    choices: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()  # shown in place of the words: scripts give the place of one
    default: int = 0

    def more(self) -> tuple[Any, ...]:
        if self.labels:
            return [tr(label) for label in self.labels], False, self.default
        return list(self.choices), False, self.choices[0], False, True

    def words(self, given: Given) -> list[str]:
        chosen = self.choices[given.place(self.name)] if self.labels else given.chosen(self.name)
        return self._option(chosen) if chosen != self.choices[0] else []


@dataclass(frozen=True)
class Language(Choice):
    """A language; the first one is the user's."""

    def more(self) -> tuple[Any, ...]:
        choices = ["de", "en"] if speaks_german() else ["en", "de"]
        return choices, False, choices[0], False, True

    def words(self, given: Given) -> list[str]:
        return self._option(given.chosen(self.name))


@dataclass(frozen=True)
class Crs(Parameter):
    """A coordinate system, an option among the further ones."""

    QGIS = QgsProcessingParameterCrs
    optional: bool = True
    advanced: bool = True

    def words(self, given: Given) -> list[str]:
        crs = given.algorithm.parameterAsCrs(given.parameters, self.name, given.context)
        return self._option(crs.authid() or crs.toWkt()) if crs.isValid() else []


@dataclass(frozen=True)
class Point(Parameter):
    """A click on the map, where a radar stands."""

    QGIS = QgsProcessingParameterPoint

    def words(self, given: Given) -> list[str]:
        """Return the click in a metric system that has a number; the worker takes it from there.

        Raises
        ------
        QgsProcessingException
            If it has no coordinate system, or is no place on earth.
        """
        known = given.parameters, self.name, given.context
        point = given.algorithm.parameterAsPoint(*known)
        crs = given.algorithm.parameterAsPointCrs(*known)
        if not crs.isValid():
            raise QgsProcessingException(
                tr("Where the radar stands: the point has no coordinate system.")
            )
        if crs.isGeographic() or not crs.authid().startswith("EPSG:"):
            metres = QgsCoordinateReferenceSystem(WEB_MERCATOR)
            way = QgsCoordinateTransform(crs, metres, given.context.transformContext())
            try:
                point, crs = way.transform(point), metres
            except QgsCsException as error:
                text = tr("Where the radar stands: {point} is no place on earth.")
                raise QgsProcessingException(text.format(point=point.toString())) from error
        place = f"{point.x():.3f},{point.y():.3f}"
        return [self.option, place, f"{self.option}-crs", crs.authid()]


@dataclass(frozen=True)
class Layer(Parameter):
    """A layer of QGIS, which the worker gets as a GeoPackage."""

    QGIS = QgsProcessingParameterFeatureSource
    source: Any = QgsProcessing.SourceType.TypeVectorPolygon
    layer: str = ""  # how it is called in the GeoPackage
    fields: tuple[str, ...] = ()  # that it must have
    metric: bool = True  # whether coordinates in degrees are refused

    def more(self) -> tuple[Any, ...]:
        return ([self.source],)

    def words(self, given: Given) -> list[str]:
        if self.optional and not given.has(self.name):
            return []
        return self._option(self.file(given, metric=self.metric))

    def file(self, given: Given, *, metric: bool) -> str:
        """Return a GeoPackage of what the user chose; see :func:`inputs.layer_file`."""
        known = given.parameters, self.name, given.context
        return layer_file(
            given.algorithm, *known, layer_name=self.layer, fields=self.fields, metric=metric
        )


@dataclass(frozen=True)
class Field(Parameter):
    """A field of a layer that another parameter gives."""

    QGIS = QgsProcessingParameterField
    of: str = ""

    def more(self) -> tuple[Any, ...]:
        return None, self.of

    def words(self, given: Given) -> list[str]:
        return self._option(given.first(self.name) if given.has(self.of) else "")


@dataclass(frozen=True)
class Output(Parameter):
    """A file that an algorithm writes; an optional one only where it is named."""

    QGIS = QgsProcessingParameterFileDestination
    flag: str | None = "-o"
    kinds: str = ""

    def more(self) -> tuple[Any, ...]:
        return _file_filter(self.kinds), None, self.optional, not self.optional

    def path(self, given: Given) -> str:
        """Return where it goes; a temporary one has another name whenever QGIS is asked."""
        known = given.parameters, self.name, given.context
        return str(given.algorithm.parameterAsFileOutput(*known))

    def words(self, given: Given) -> list[str]:
        return self._option(given.outputs[self.name])


@dataclass(frozen=True)
class OutputFolder(Output):
    """A folder that an algorithm writes."""

    QGIS = QgsProcessingParameterFolderDestination

    def more(self) -> tuple[Any, ...]:
        return None, self.optional, not self.optional


@dataclass(frozen=True)
class OutputLayer(Output):
    """A layer that an algorithm writes, and QGIS loads."""

    QGIS = QgsProcessingParameterVectorDestination

    def more(self) -> tuple[Any, ...]:
        return ()

    def path(self, given: Given) -> str:
        known = given.parameters, self.name, given.context
        return str(given.algorithm.parameterAsOutputLayer(*known))


@dataclass(frozen=True)
class Result(Parameter):
    """A result that follows from the others, for models and scripts."""

    kind: Any = None

    def words(self, given: Given) -> list[str]:
        del given
        return []

    def add_to(self, algorithm: Any) -> None:
        algorithm.addOutput(self.kind(self.name, tr(self.title)))
