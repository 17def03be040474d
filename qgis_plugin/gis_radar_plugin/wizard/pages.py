"""The pages of the site wizard but the last: map and scan, radars, time and results."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from qgis.gui import QgsFileWidget
from qgis.PyQt.QtCore import QTimeZone
from qgis.PyQt.QtWidgets import (
    QComboBox,
    QFileDialog,
    QFormLayout,
    QGroupBox,
    QHBoxLayout,
    QLabel,
    QListWidget,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)

from ..words import WINDS, tr
from .draft import SensorDraft, next_name
from .page import Page, button, crs_box, file_box, line, note, spin, switch

ONE_WORLD_M = 1e8
SEARCHED = -1.0  # of a direction: none is known


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
        form.addRow("", button(tr("Open a site..."), self._ask_for_site))
        self.title_box = self.row(
            form, "title", tr("Name of the site"), line(tr("such as: Main Street / Station Road"))
        )
        lanelets = file_box(tr("Lanelet2 maps") + " (*.osm *.xml)")
        self.map_box = self.row(form, "map_file", tr("Lanelet2 map"), lanelets)
        self.map_box.fileChanged.connect(self._map_chosen)
        self.status = QLabel()
        self.status.setWordWrap(True)
        form.addRow("", self.status)
        several = QgsFileWidget.StorageMode.GetMultipleFiles
        scans = file_box(tr("Point clouds") + " (*.laz *.las)", several)
        self.scan_box = self.row(form, "scans", tr("Airborne scans"), scans)
        form.addRow("", note(tr(
            "The scan finds the radars, gives heights, and shows what houses hide. Without one "
            "the pose of each radar must be known."
        )))  # fmt: skip
        more = QGroupBox(tr("Only where needed"))
        self._add_more(QFormLayout(more))
        form.addRow(more)

    def _add_more(self, form: QFormLayout) -> None:
        self.crs_box = self.row(
            form, "crs", tr("Coordinate system"), crs_box(tr("UTM zone of the site"))
        )
        self.crs_box.crsChanged.connect(lambda _: self._read_map())
        self.row(form, "scan_crs", tr("CRS of the scans"), crs_box(tr("as the scans state")))
        self.origin_box = self.row(
            form, "origin", tr("Origin of a map without true positions"),
            line("690400.0, 5336200.0"),
        )  # fmt: skip
        self.origin_box.editingFinished.connect(self._read_map)
        self.row(
            form, "map_source", tr("Source of the map"), line(tr("City of Example, CC BY 4.0"))
        )
        self.row(
            form, "scan_source", tr("Source of the scans"), line(tr("State survey, dl-de/by-2-0"))
        )

    def _ask_for_site(self) -> None:
        kinds = tr("Site files") + " (*.toml)"
        path, _ = QFileDialog.getOpenFileName(self, tr("Open a site..."), "", kinds)
        if path:
            self.wizard().open_site(Path(path))

    def fill(self, source: Any = None) -> None:
        """Show map and scans of the draft, and read the map."""
        super().fill(source)
        self._read_map()

    def _map_chosen(self, path: str) -> None:
        if not self.title_box.text() and path:
            self.title_box.setText(Path(path).stem)
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
        self.list.currentRowChanged.connect(lambda _: self._show_chosen())
        place = self._place
        self.place_button = button(tr("Place a radar on the map"), lambda: place(None))
        self.again_button = button(tr("Place it again"), lambda: place(self.chosen()))
        self.remove_button = button(tr("Remove it"), self._remove)
        for part in (self.list, self.place_button, self.again_button, self.remove_button):
            left.addWidget(part)
        across.addLayout(left, 2)
        self.form = QWidget()
        self._fill_form(QFormLayout(self.form))
        across.addWidget(self.form, 5)
        self._show_chosen()

    def _place(self, sensor: SensorDraft | None) -> None:
        self.wizard().place_on_map(sensor)

    def _fill_form(self, form: QFormLayout) -> None:
        self.row(form, "name", tr("Name"), line())
        self.east_box = self.bind("easting", spin(0.0, ONE_WORLD_M, 2))
        place = QHBoxLayout()
        place.addWidget(self.east_box)
        place.addWidget(self.bind("northing", spin(-1e7, ONE_WORLD_M, 2)))
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
        poses = file_box(tr("Poses") + " (*.json *.csv)")
        poses.lineEdit().setPlaceholderText(tr("only where it was surveyed"))
        self.row(form, "pose", tr("Pose file"), poses)
        self.row(form, "cycle", tr("Cycle"), line(tr("only for radars under 10 Hz: 150ms")))
        form.addRow(self._view())

    def _recordings(self) -> QWidget:
        inside = QWidget()
        column = QVBoxLayout(inside)
        column.setContentsMargins(0, 0, 0, 0)
        self.recordings = QListWidget()
        self.recordings.setMaximumHeight(90)
        inside.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
        column.addWidget(self.recordings)
        buttons = QHBoxLayout()
        buttons.addWidget(button(tr("Add files..."), self._ask_for_recordings))
        buttons.addWidget(button(tr("Remove"), self._remove_recording))
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
        form.addRow(tr("Opening angle, degrees"), self.azimuth_box)
        form.addRow(tr("Range, m"), self.range_box)
        self.view_group.toggled.connect(self._view_entered)
        self.azimuth_box.valueChanged.connect(self._view_entered)
        self.range_box.valueChanged.connect(self._view_entered)
        return self.view_group

    # What the page shows is the chosen sensor of the draft.

    def chosen(self) -> SensorDraft | None:
        """Return the sensor that is shown, None where there is none."""
        sensors = self.draft.sensors if self.wizard() is not None else []
        row = self.list.currentRow()
        return sensors[row] if 0 <= row < len(sensors) else None

    def keep(self, key: str, value: Any) -> None:
        """Put a value into the chosen sensor, and draw it."""
        sensor = self.chosen()
        if sensor is None:
            return
        setattr(sensor, key, value)
        self.list.currentItem().setText(_listed(sensor))
        self.wizard().draw_sensors(sensor)
        self.completeChanged.emit()

    def add(self, easting: float, northing: float, heading: float | None) -> None:
        """Add a radar that was placed on the map."""
        sensors = self.draft.sensors
        sensors.append(SensorDraft(next_name(sensors), [], easting, northing, heading))
        self.refresh(len(sensors) - 1)

    def refresh(self, row: int | None = None) -> None:
        """Show the sensors of the draft again."""
        row = self.list.currentRow() if row is None else row
        self.list.blockSignals(True)
        self.list.clear()
        self.list.addItems([_listed(sensor) for sensor in self.draft.sensors])
        self.list.setCurrentRow(row)
        self.list.blockSignals(False)
        self._show_chosen()
        self.completeChanged.emit()

    def _show_chosen(self) -> None:
        sensor = self.chosen()
        for part in (self.form, self.again_button, self.remove_button):
            part.setEnabled(sensor is not None)
        if sensor is None:
            return
        self.fill(sensor)
        yaw, view = sensor.heading, sensor.seen
        self.recordings.clear()
        self.recordings.addItems([Path(path).name for path in sensor.recordings])
        quiet = (self.bearing_box, self.view_group, self.azimuth_box, self.range_box)
        for box in quiet:
            box.blockSignals(True)
        self.bearing_box.setValue(SEARCHED if yaw is None else (90.0 - yaw) % 360.0)
        self.view_group.setChecked(bool(sensor.view))
        self.azimuth_box.setValue(view.get("azimuth_deg", 120.0))
        self.range_box.setValue(view.get("max_range_m", 300.0))
        for box in quiet:
            box.blockSignals(False)
        self._show_wind()
        self.wizard().draw_sensors(sensor)

    def _bearing_chosen(self, bearing: float) -> None:
        self.keep("heading", None if bearing < 0.0 else (90.0 - bearing + 180.0) % 360.0 - 180.0)
        self._show_wind()

    def _show_wind(self) -> None:
        bearing = self.bearing_box.value()
        self.wind.setText("" if bearing < 0.0 else tr(WINDS[round(bearing / 45.0) % 8]))

    def _view_entered(self, *_: Any) -> None:
        sensor = self.chosen()
        entered = {
            **(sensor.view if sensor is not None else {}),
            "azimuth_deg": self.azimuth_box.value(), "max_range_m": self.range_box.value(),
        }  # fmt: skip
        self.keep("view", entered if self.view_group.isChecked() else {})

    def _ask_for_recordings(self) -> None:
        kinds = tr("Recordings") + " (*.parquet *.csv);;" + tr("All files") + " (*)"
        chosen, _ = QFileDialog.getOpenFileNames(self, tr("Recordings"), "", kinds)
        self.add_recordings(chosen)

    def add_recordings(self, paths: list[str]) -> None:
        """Add files to the chosen radar, each once."""
        sensor = self.chosen()
        if sensor is not None:
            self._record(sensor, list(dict.fromkeys([*sensor.recordings, *paths])))

    def _remove_recording(self) -> None:
        sensor, row = self.chosen(), self.recordings.currentRow()
        if sensor is not None and row >= 0:
            self._record(sensor, [*sensor.recordings[:row], *sensor.recordings[row + 1 :]])

    def _record(self, sensor: SensorDraft, recordings: list[str]) -> None:
        sensor.recordings, sensor.measured = recordings, {}
        self.refresh()

    def _remove(self) -> None:
        row = self.list.currentRow()
        if self.chosen() is not None:
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
        self.interval_box = line()
        self.interval_box.setText("15min")
        self.interval_box.textChanged.connect(self._intervals_typed)
        form.addRow(tr("Intervals"), self.interval_box)
        form.addRow("", note(tr(
            "Length of the intervals: 20s, 15min, 1h; empty for the whole time only."
        )))  # fmt: skip
        follow = switch(tr("Follow vehicles: the maps show occupancy"), on=True)
        moving = switch(tr("Single vehicles that move on the map (not to be published)"), on=False)
        follow.toggled.connect(moving.setEnabled)
        self.row(form, "follow", "", follow)
        self.row(form, "footprints", "", moving)
        self.row(form, "vehicles_only", "", switch(
            tr("Count as hits only what is -0.5 to 4.5 m over the road"), on=True
        ))  # fmt: skip
        clocks = file_box(tr("Clocks") + " (*.json)")
        self.row(form, "clocks", tr("Clocks, from 'Compare clocks'"), clocks)
        self.row(form, "attribution", tr("Whom to name"), line(tr("City of Example")))

    def fill(self, source: Any = None) -> None:
        """Show zone, intervals, switches and clocks of the draft."""
        zone, intervals = self.draft.timezone, ", ".join(self.draft.intervals)
        super().fill(source)
        self.boxes["footprints"].setEnabled(self.draft.follow)
        self.zone_box.setCurrentText(zone)
        self.interval_box.setText(intervals)

    def initializePage(self) -> None:  # noqa: N802
        """Take the values that are shown."""
        self.draft.timezone = self.zone_box.currentText()
        self._intervals_typed(self.interval_box.text())

    def _intervals_typed(self, text: str) -> None:
        parts = [part.replace(" ", "") for part in re.split("[,;]", text)]
        self.keep("intervals", [part for part in parts if part])

    def isComplete(self) -> bool:  # noqa: N802
        """Return whether there is such a zone."""
        return bool(QTimeZone(self.draft.timezone.encode()).isValid())


def _listed(sensor: SensorDraft) -> str:
    """Return a sensor as the list shows it."""
    return tr("{name}, files: {count}").format(name=sensor.name, count=len(sensor.recordings))
