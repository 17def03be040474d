"""The pages of the site wizard but the last: map and scan, radars, time and what is made."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from qgis.core import QgsCoordinateReferenceSystem
from qgis.gui import QgsProjectionSelectionWidget
from qgis.PyQt.QtCore import QTimeZone
from qgis.PyQt.QtWidgets import (
    QComboBox,
    QFileDialog,
    QFormLayout,
    QGroupBox,
    QHBoxLayout,
    QLabel,
    QLineEdit,
    QListWidget,
    QPushButton,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)

from ..words import WINDS, tr
from .draft import SensorDraft, next_name
from .page import Page, file_box, files_in, note, spin

ONE_WORLD_M = 1e8
SEARCHED = -1.0  # of a direction: none is known
_SEPARATORS = (",", ";")


def wind_of(bearing: float) -> str:
    """Return the word for a direction in the user's language."""
    return tr(WINDS[round(bearing / 45.0) % 8])


def bearing_of_heading(heading: float) -> float:
    """Return degrees clockwise from grid north of a yaw."""
    return (90.0 - heading) % 360.0


class MapPage(Page):
    """The site's name, its map and its scans; the map is read and shown at once."""

    TITLE = "Map and laser scan"
    SUBTITLE = (
        "The map of the lanes (Lanelet2) and the airborne laser scan of the site. The lanes are "
        "shown in QGIS as soon as the map is chosen."
    )

    def __init__(self) -> None:
        super().__init__()
        form = QFormLayout(self)
        self.open_button = QPushButton(tr("Open a site..."))
        self.open_button.clicked.connect(self._ask_for_site)
        form.addRow("", self.open_button)
        self.title_box = self.line("title", tr("such as: Main Street / Station Road"))
        form.addRow(tr("Name of the site"), self.title_box)
        self.map_box = file_box(tr("Lanelet2 maps") + " (*.osm *.xml)")
        self.map_box.fileChanged.connect(self._map_chosen)
        form.addRow(tr("Lanelet2 map"), self.map_box)
        self.status = QLabel()
        self.status.setWordWrap(True)
        form.addRow("", self.status)
        self.scan_box = file_box(tr("Point clouds") + " (*.laz *.las)", several=True)
        self.scan_box.fileChanged.connect(lambda text: self.keep("scans", files_in(text)))
        form.addRow(tr("Airborne scans"), self.scan_box)
        form.addRow("", note(tr(
            "The scan finds the radars, gives heights, and shows what houses hide. Without one "
            "the pose of each radar must be known."
        )))  # fmt: skip
        more = QGroupBox(tr("Only where needed"))
        more.setLayout(self._more())
        form.addRow(more)

    def _more(self) -> QFormLayout:
        inside = QFormLayout()
        self.crs_box = QgsProjectionSelectionWidget()
        self.crs_box.setOptionVisible(QgsProjectionSelectionWidget.CrsOption.CrsNotSet, True)
        self.crs_box.setNotSetText(tr("UTM zone of the site"))
        self.crs_box.setCrs(QgsCoordinateReferenceSystem())
        self.crs_box.crsChanged.connect(self._crs_chosen)
        inside.addRow(tr("Coordinate system"), self.crs_box)
        self.scan_crs_box = QgsProjectionSelectionWidget()
        self.scan_crs_box.setOptionVisible(QgsProjectionSelectionWidget.CrsOption.CrsNotSet, True)
        self.scan_crs_box.setNotSetText(tr("as the scans state"))
        self.scan_crs_box.setCrs(QgsCoordinateReferenceSystem())
        self.scan_crs_box.crsChanged.connect(lambda crs: self.keep("scan_crs", _name_of(crs)))
        inside.addRow(tr("CRS of the scans"), self.scan_crs_box)
        self.origin_box = self.line("origin", "690400.0, 5336200.0")
        self.origin_box.editingFinished.connect(self._read_map)
        inside.addRow(tr("Origin of a map without true positions"), self.origin_box)
        inside.addRow(
            tr("Source of the map"), self.line("map_source", tr("City of Example, CC BY 4.0"))
        )
        inside.addRow(
            tr("Source of the scans"), self.line("scan_source", tr("State survey, dl-de/by-2-0"))
        )
        return inside

    def _ask_for_site(self) -> None:
        kinds = tr("Site files") + " (*.toml)"
        path, _ = QFileDialog.getOpenFileName(self, tr("Open a site..."), "", kinds)
        if path:
            self.wizard().open_site(Path(path))

    def fill(self) -> None:
        """Show map and scans of the draft, and read the map."""
        draft, quiet = self.draft, (self.map_box, self.scan_box, self.crs_box, self.scan_crs_box)
        for box in quiet:
            box.blockSignals(True)
        super().fill()
        self.map_box.setFilePath(draft.map_file)
        self.scan_box.setFilePath(" ".join(f'"{path}"' for path in draft.scans))
        self.crs_box.setCrs(QgsCoordinateReferenceSystem(draft.crs))
        self.scan_crs_box.setCrs(QgsCoordinateReferenceSystem(draft.scan_crs))
        for box in quiet:
            box.blockSignals(False)
        self._read_map()

    def _map_chosen(self, path: str) -> None:
        self.keep("map_file", path.strip())
        if not self.title_box.text() and path:
            self.title_box.setText(Path(path).stem)
        self._read_map()

    def _crs_chosen(self, crs: QgsCoordinateReferenceSystem) -> None:
        self.keep("crs", _name_of(crs))
        self._read_map()

    def _read_map(self) -> None:
        self.status.clear()
        if self.draft.map_file and Path(self.draft.map_file).is_file():
            self.wizard().lanes.read(self.draft)

    def show_status(self, text: str, *, good: bool) -> None:
        """Say whether the map could be read."""
        self.status.setText(text)
        self.status.setStyleSheet("" if good else "color: #b91c1c")
        self.completeChanged.emit()

    def isComplete(self) -> bool:  # noqa: N802
        """Return whether the lanes are shown: radars are placed on them."""
        return bool(self.draft.title and self.wizard().lanes.crs is not None)


class RadarPage(Page):
    """The radars: where each stands and looks, what it recorded, what it sees."""

    TITLE = "Radars"
    SUBTITLE = (
        "Click on the map where each radar stands, within 15 m, and drag to where it looks. "
        "A click without dragging leaves the direction open: it is then found from the traffic."
    )

    def __init__(self) -> None:
        super().__init__()
        across = QHBoxLayout(self)
        left = QVBoxLayout()
        self.list = QListWidget()
        self.list.currentRowChanged.connect(self._show_chosen)
        left.addWidget(self.list)
        self.place_button = QPushButton(tr("Place a radar on the map"))
        self.place_button.clicked.connect(lambda: self.wizard().place_on_map(None))
        self.again_button = QPushButton(tr("Place it again"))
        self.again_button.clicked.connect(lambda: self.wizard().place_on_map(self.chosen()))
        self.remove_button = QPushButton(tr("Remove it"))
        self.remove_button.clicked.connect(self._remove)
        for button in (self.place_button, self.again_button, self.remove_button):
            left.addWidget(button)
        across.addLayout(left, 2)
        self.form = QWidget()
        self.form.setLayout(self._form())
        across.addWidget(self.form, 5)
        self._filling = False
        self._show_chosen(-1)

    def _form(self) -> QFormLayout:
        form = QFormLayout()
        self.name_box = QLineEdit()
        self.name_box.textEdited.connect(lambda text: self._set("name", text.strip()))
        form.addRow(tr("Name"), self.name_box)
        self.east_box, self.north_box = spin(0.0, ONE_WORLD_M, 2), spin(-1e7, ONE_WORLD_M, 2)
        self.east_box.valueChanged.connect(lambda value: self._set("easting", value))
        self.north_box.valueChanged.connect(lambda value: self._set("northing", value))
        place = QHBoxLayout()
        place.addWidget(self.east_box)
        place.addWidget(self.north_box)
        form.addRow(tr("Easting, northing, m"), place)
        self.bearing_box = spin(SEARCHED, 359.9, 1)
        self.bearing_box.setSpecialValueText(tr("is searched"))
        self.bearing_box.setWrapping(True)
        self.bearing_box.valueChanged.connect(self._bearing_chosen)
        self.wind = QLabel()
        looks = QHBoxLayout()
        looks.addWidget(self.bearing_box)
        looks.addWidget(self.wind, 1)
        form.addRow(tr("Looks to, degrees from north"), looks)
        form.addRow(tr("Recordings"), self._recordings())
        self.pose_box = file_box(tr("Poses") + " (*.json *.csv)")
        self.pose_box.lineEdit().setPlaceholderText(
            tr("only if surveyed: then nothing is searched")
        )
        self.pose_box.fileChanged.connect(lambda text: self._set("pose", text.strip()))
        form.addRow(tr("Pose file"), self.pose_box)
        self.cycle_box = QLineEdit()
        self.cycle_box.setPlaceholderText(tr("only for radars under 10 Hz: 150ms"))
        self.cycle_box.textEdited.connect(lambda text: self._set("cycle", text.strip()))
        form.addRow(tr("Cycle"), self.cycle_box)
        form.addRow(self._view())
        return form

    def _recordings(self) -> QWidget:
        inside = QWidget()
        column = QVBoxLayout(inside)
        column.setContentsMargins(0, 0, 0, 0)
        self.recordings = QListWidget()
        self.recordings.setMaximumHeight(90)
        inside.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
        column.addWidget(self.recordings)
        buttons = QHBoxLayout()
        add, remove = QPushButton(tr("Add files...")), QPushButton(tr("Remove"))
        add.clicked.connect(self._ask_for_recordings)
        remove.clicked.connect(self._remove_recording)
        buttons.addWidget(add)
        buttons.addWidget(remove)
        column.addLayout(buttons)
        return inside

    def _view(self) -> QGroupBox:
        self.view_group = QGroupBox(
            tr("Enter the view by hand (else it is taken from the recordings)")
        )
        self.view_group.setCheckable(True)
        self.view_group.setChecked(False)
        form = QFormLayout(self.view_group)
        self.azimuth_box, self.range_box = spin(1.0, 360.0, 0), spin(1.0, 10_000.0, 0)
        self.azimuth_box.setValue(120.0)
        self.range_box.setValue(300.0)
        form.addRow(tr("Opening angle, degrees"), self.azimuth_box)
        form.addRow(tr("Range, m"), self.range_box)
        self.view_group.toggled.connect(self._view_entered)
        self.azimuth_box.valueChanged.connect(self._view_entered)
        self.range_box.valueChanged.connect(self._view_entered)
        return self.view_group

    # What the page shows is the chosen sensor of the draft.

    def chosen(self) -> SensorDraft | None:
        """Return the sensor that is shown, None where there is none."""
        row = self.list.currentRow()
        return self.draft.sensors[row] if 0 <= row < len(self.draft.sensors) else None

    def add(self, easting: float, northing: float, heading: float | None) -> None:
        """Add a radar that was placed on the map."""
        self.draft.sensors.append(
            SensorDraft(
                next_name(self.draft.sensors), easting=easting, northing=northing, heading=heading
            )
        )
        self.refresh(len(self.draft.sensors) - 1)

    def refresh(self, row: int | None = None) -> None:
        """Show the sensors of the draft again."""
        row = self.list.currentRow() if row is None else row
        self.list.blockSignals(True)
        self.list.clear()
        for sensor in self.draft.sensors:
            self.list.addItem(_listed(sensor))
        self.list.setCurrentRow(row)
        self.list.blockSignals(False)
        self._show_chosen(row)
        self.completeChanged.emit()

    def _show_chosen(self, _row: int) -> None:
        sensor = self.chosen() if self.wizard() is not None else None
        self.form.setEnabled(sensor is not None)
        self.again_button.setEnabled(sensor is not None)
        self.remove_button.setEnabled(sensor is not None)
        if sensor is None:
            return
        self._filling = True
        self.name_box.setText(sensor.name)
        self.east_box.setValue(0.0 if math.isnan(sensor.easting) else sensor.easting)
        self.north_box.setValue(0.0 if math.isnan(sensor.northing) else sensor.northing)
        yaw = sensor.heading
        self.bearing_box.setValue(SEARCHED if yaw is None else bearing_of_heading(yaw))
        self.recordings.clear()
        self.recordings.addItems([Path(path).name for path in sensor.recordings])
        self.pose_box.setFilePath(sensor.pose)
        self.cycle_box.setText(sensor.cycle)
        self.view_group.setChecked(bool(sensor.view))
        self.azimuth_box.setValue(sensor.seen.get("azimuth_deg", 120.0))
        self.range_box.setValue(sensor.seen.get("max_range_m", 300.0))
        self._filling = False
        self._show_wind()
        self.wizard().draw_sensors(sensor)

    def _set(self, key: str, value: Any) -> None:
        sensor = self.chosen()
        if sensor is None or self._filling:
            return
        setattr(sensor, key, value)
        if key == "name":
            self.list.currentItem().setText(_listed(sensor))
        self.wizard().draw_sensors(sensor)
        self.completeChanged.emit()

    def _bearing_chosen(self, bearing: float) -> None:
        self._set("heading", None if bearing < 0.0 else (90.0 - bearing + 180.0) % 360.0 - 180.0)
        self._show_wind()

    def _show_wind(self) -> None:
        bearing = self.bearing_box.value()
        self.wind.setText("" if bearing < 0.0 else wind_of(bearing))

    def _view_entered(self, *_: Any) -> None:
        sensor = self.chosen()
        known = sensor.view if sensor is not None else {}
        entered = {
            **known,
            "azimuth_deg": self.azimuth_box.value(),
            "max_range_m": self.range_box.value(),
        }
        self._set("view", entered if self.view_group.isChecked() else {})

    def _ask_for_recordings(self) -> None:
        kinds = tr("Recordings") + " (*.parquet *.csv);;" + tr("All files") + " (*)"
        chosen, _ = QFileDialog.getOpenFileNames(self, tr("Recordings"), "", kinds)
        self.add_recordings(chosen)

    def add_recordings(self, paths: list[str]) -> None:
        """Add files to the chosen radar, each once."""
        sensor = self.chosen()
        if sensor is not None:
            sensor.recordings = list(dict.fromkeys([*sensor.recordings, *paths]))
            sensor.measured = {}
            self.refresh()

    def _remove_recording(self) -> None:
        sensor, row = self.chosen(), self.recordings.currentRow()
        if sensor is not None and 0 <= row < len(sensor.recordings):
            del sensor.recordings[row]
            sensor.measured = {}
            self.refresh()

    def _remove(self) -> None:
        row = self.list.currentRow()
        if 0 <= row < len(self.draft.sensors):
            del self.draft.sensors[row]
            self.refresh(min(row, len(self.draft.sensors) - 1))
            self.wizard().draw_sensors(self.chosen())

    def isComplete(self) -> bool:  # noqa: N802
        """Return whether each radar stands somewhere and has recorded something."""
        sensors = self.draft.sensors
        return bool(sensors) and all(
            each.name and each.recordings and each.is_placed for each in sensors
        )


class ResultPage(Page):
    """Time zone, intervals, and what else the run makes."""

    TITLE = "Time and results"
    SUBTITLE = "Whose clocks count, and what is made of the recordings."

    def __init__(self) -> None:
        super().__init__()
        form = QFormLayout(self)
        self.zone_box = QComboBox()
        self.zone_box.setEditable(True)
        zones = [bytes(name).decode() for name in QTimeZone.availableTimeZoneIds()]
        self.zone_box.addItems([name for name in zones if "/" in name or name == "UTC"])
        self.zone_box.setCurrentText(bytes(QTimeZone.systemTimeZoneId()).decode())
        self.zone_box.currentTextChanged.connect(lambda text: self.keep("timezone", text.strip()))
        form.addRow(tr("Time zone"), self.zone_box)
        form.addRow("", note(tr(
            "Pictures, sheets and the report show the time of this zone, also where the site "
            "lies across a border of zones. The data files stay in UTC."
        )))  # fmt: skip
        self.interval_box = QLineEdit("15min")
        self.interval_box.textChanged.connect(self._intervals_typed)
        form.addRow(tr("Intervals"), self.interval_box)
        form.addRow("", note(tr(
            "Length of the intervals: 20s, 15min, 1h; empty for the whole time only."
        )))  # fmt: skip
        follow = self.switch("follow", tr("Follow vehicles: the maps show occupancy"), on=True)
        form.addRow("", follow)
        moving = self.switch(
            "footprints", tr("Single vehicles that move on the map (not to be published)"), on=False
        )
        follow.toggled.connect(moving.setEnabled)
        self.moving_box = moving
        form.addRow("", moving)
        form.addRow("", self.switch(
            "vehicles_only", tr("Count as hits only what is -0.5 to 4.5 m over the road"), on=True
        ))  # fmt: skip
        self.clocks_box = file_box(tr("Clocks") + " (*.json)")
        self.clocks_box.fileChanged.connect(lambda text: self.keep("clocks", text.strip()))
        form.addRow(tr("Clocks, from 'Compare clocks'"), self.clocks_box)
        form.addRow(tr("Whom to name"), self.line("attribution", tr("City of Example")))

    def fill(self) -> None:
        """Show zone, intervals, switches and clocks of the draft."""
        draft = self.draft
        zone, intervals, clocks = draft.timezone, ", ".join(draft.intervals), draft.clocks
        super().fill()
        self.zone_box.setCurrentText(zone)
        self.interval_box.setText(intervals)
        self.clocks_box.setFilePath(clocks)

    def initializePage(self) -> None:  # noqa: N802
        """Take the values that are shown."""
        self.draft.timezone = self.zone_box.currentText()
        self._intervals_typed(self.interval_box.text())

    def _intervals_typed(self, text: str) -> None:
        for separator in _SEPARATORS[1:]:
            text = text.replace(separator, _SEPARATORS[0])
        parts = [part.strip().replace(" ", "") for part in text.split(_SEPARATORS[0])]
        self.keep("intervals", [part for part in parts if part])

    def isComplete(self) -> bool:  # noqa: N802
        """Return whether there is such a zone."""
        return bool(QTimeZone(self.draft.timezone.encode()).isValid())


def _name_of(crs: QgsCoordinateReferenceSystem) -> str:
    return str(crs.authid() or crs.toWkt()) if crs.isValid() else ""


def _listed(sensor: SensorDraft) -> str:
    """Return a sensor as the list shows it."""
    return tr("{name}, files: {count}").format(name=sensor.name, count=len(sensor.recordings))
