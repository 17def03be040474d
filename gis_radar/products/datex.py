"""Publications of traffic by DATEX II version 3.

DATEX II (CEN/TS 16157) sends what is measured apart from the table of where it is measured: each
lane is a measurement site, whose quantities have numbers.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import geopandas as gpd
import pandas as pd

from gis_radar.base import UsageError, current_language, iso_from_time
from gis_radar.products.results_folder import write_xml

_DATEX = {
    **{
        f"xmlns:{prefix}": f"http://datex2.eu/schema/3/{name}"
        for prefix, name in (
            ("d2", "d2Payload"), ("com", "common"), ("loc", "locationReferencing"),
            ("roa", "roadTrafficData"),
        )
    },
    "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
}  # fmt: skip
# Numbers of the quantities of a site, in the table and in what is measured.
_FLOW, _SPEED, _CONCENTRATION = 1, 2, 3
_QUANTITIES = {
    _FLOW: "trafficFlow", _SPEED: "trafficSpeed", _CONCENTRATION: "trafficConcentration"
}  # fmt: skip
_LETTERS = 1024  # most that a text of DATEX II has
# What no XML may hold; names of a layer of streets may.
_NO_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_DEGREES = 7  # decimals of latitudes and longitudes: a centimetre


def publisher_of(text: str) -> tuple[str, str]:
    """Return country and name of a publisher, as in `DE:City of Example`.

    Raises
    ------
    UsageError
        If it is not a country of two letters, a colon and a name of a line.
    """
    country, _, name = (part.strip() for part in text.partition(":"))
    is_country = len(country) == 2 and country.isascii() and country.isalpha()
    if not (is_country and 0 < len(name) <= _LETTERS and name.isprintable()):
        raise UsageError(
            "the publisher is {}, expected a country and a name such as 'DE:City of Example'",
            repr(text),
        )
    return country.lower(), name


def write_datex_sites(lanes: gpd.GeoDataFrame, publisher: tuple[str, str], path: Path) -> None:
    """Write the table of measurement sites: each lane with its name, its line and its quantities.

    Parameters
    ----------
    lanes : GeoDataFrame
        From :meth:`gis_radar.Dataset.traffic`.
    publisher : (str, str)
        From :func:`publisher_of`.
    path : Path
        The file: a MeasurementSiteTablePublication.
    """
    root = _publication("MeasurementSiteTablePublication", lanes, publisher)
    _add_header(root)
    version, period_s = _version(lanes), _period_s(lanes)
    table = SubElement(root, "roa:measurementSiteTable", id=publisher[1], version=version)
    sites = lanes.drop_duplicates("lane").to_crs("EPSG:4326")
    for site in sites.itertuples():
        place = SubElement(table, "roa:measurementSite", id=str(site.lane), version=version)
        name = SubElement(SubElement(place, "roa:measurementSiteName"), "com:values")
        _add(name, "com:value", site.name, lang=current_language())
        _add(place, "roa:measurementSiteNumberOfLanes", 1)
        for index, quantity in _QUANTITIES.items():
            outer = "roa:measurementSpecificCharacteristics"
            inner = SubElement(SubElement(place, outer, index=str(index)), outer)
            _add(inner, "roa:period", f"{period_s:g}")
            _add(inner, "roa:specificMeasurementValueType", quantity)
        linear = {"xsi:type": "loc:LinearLocation"}
        where = SubElement(place, "roa:measurementSiteLocation", linear)
        line = SubElement(where, "loc:gmlLineString", srsName="EPSG:4326")
        pairs = [f"{y:.{_DEGREES}f} {x:.{_DEGREES}f}" for x, y, *_ in site.geometry.coords]
        _add(line, "loc:posList", " ".join(pairs))
    write_xml(root, path)


def write_datex_measurements(
    lanes: gpd.GeoDataFrame, publisher: tuple[str, str], path: Path
) -> None:
    """Write flow, speed, occupancy and density of each lane and interval; what is null is left out.

    Parameters
    ----------
    lanes, publisher
        As for :func:`write_datex_sites`.
    path : Path
        The file: a MeasuredDataPublication.
    """
    root, version = _publication("MeasuredDataPublication", lanes, publisher), _version(lanes)
    table = {"targetClass": "roa:MeasurementSiteTable", "id": publisher[1], "version": version}
    SubElement(root, "roa:measurementSiteTableReference", table)
    _add_header(root)
    for row in lanes.drop(columns="geometry").to_dict("records"):
        site = SubElement(root, "roa:siteMeasurements")
        lane = {"targetClass": "roa:MeasurementSite", "id": str(row["lane"]), "version": version}
        SubElement(site, "roa:measurementSiteReference", lane)
        for index, kind, values in _quantities(row):
            outer = SubElement(site, "roa:physicalQuantity", index=str(index))
            single = {"xsi:type": "roa:SinglePhysicalQuantity"}
            inner = SubElement(outer, "roa:physicalQuantity", single)
            SubElement(inner, "roa:basicData", {"xsi:type": f"roa:{kind}"}).extend(values)
        time = SubElement(site, "roa:measurementTimeDefault")
        _add(time, "roa:timeMeaning", "beginTime")
        _add(time, "roa:timeValue", iso_from_time(row["begin"]))
        period = SubElement(time, "roa:period")
        _add(period, "com:startOfPeriod", iso_from_time(row["begin"]))
        _add(period, "com:endOfPeriod", iso_from_time(row["end"]))
    write_xml(root, path)


def _period_s(lanes: gpd.GeoDataFrame) -> float:
    return float((lanes["end"] - lanes["begin"]).max().total_seconds())


def _version(lanes: gpd.GeoDataFrame) -> str:
    """Return the version of the table and of its sites: other sites or periods give another."""
    sites = lanes.drop_duplicates("lane")
    stated = zip(sites["lane"], sites["name"], sites.geometry.to_wkt(), strict=True)
    content = [current_language(), _period_s(lanes), *stated]
    return hashlib.blake2b(repr(content).encode(), digest_size=8).hexdigest()


def _quantities(row: dict[Any, Any]) -> Iterator[tuple[int, str, list[Element]]]:
    """Yield number, type and values of what is known, in the order of the schema."""
    if pd.notna(row["volume_veh_h"]):
        flow = [_value("vehicleFlow", "com:vehicleFlowRate", round(row["volume_veh_h"]),
                       accuracy=_accuracy(row, "volume"), count=row["counted"])]  # fmt: skip
        if row["counted"]:
            heavy = 100.0 * row["heavy"] / row["counted"]
            flow.insert(0, _value("percentageLongVehicles", "com:percentage", f"{heavy:.1f}"))
        yield _FLOW, "TrafficFlow", flow
    if pd.notna(row["speed_time_mean_kmh"]):
        mean = f"{row['speed_time_mean_kmh']:.1f}"
        speed = [_value("averageVehicleSpeed", "com:speed", mean, count=row["counted"])]
        if pd.notna(row["speed_85_kmh"]):
            speed.append(Element("roa:speedPercentile"))
            speed_85 = f"{row['speed_85_kmh']:.1f}"
            speed[-1].append(_value("vehiclePercentage", "com:percentage", 85))
            speed[-1].append(_value("speedPercentile", "com:speed", speed_85))
        yield _SPEED, "TrafficSpeed", speed
    if pd.notna(row["occupancy"]):
        share = f"{100.0 * row['occupancy']:.2f}"
        accuracy = _accuracy(row, "occupancy")
        dense = [_value("occupancy", "com:percentage", share, accuracy=accuracy)]
        if pd.notna(row["density_veh_km"]):
            density = round(row["density_veh_km"])
            dense.insert(0, _value("density", "roa:densityOfVehicles", density))
        yield _CONCENTRATION, "TrafficConcentration", dense


def _accuracy(row: dict[Any, Any], name: str) -> str | None:
    """Return the accuracy that DATEX II asks for: 100 % less the relative standard error."""
    value, error = row[name], row[f"{name}_se"]
    known = pd.notna(error) and value > 0.0
    return f"{max(0.0, 100.0 * (1.0 - error / value)):.1f}" if known else None


def _value(
    name: str, unit: str, value: object, *, accuracy: str | None = None, count: int | None = None
) -> Element:
    """Return a value with its accuracy and the number of vehicles it is of, where known."""
    element = Element(f"roa:{name}")
    if count is not None:
        element.set("numberOfInputValuesUsed", str(count))
    if accuracy is not None:
        element.set("accuracy", accuracy)
    _add(element, unit, value)
    return element


def _publication(kind: str, lanes: pd.DataFrame, publisher: tuple[str, str]) -> Element:
    """Return a publication, dated to the last interval so that equal traffic gives equal bytes."""
    stated = {"xsi:type": f"roa:{kind}", "lang": current_language(), "modelBaseVersion": "3"}
    root = Element("d2:payload", _DATEX | stated)
    _add(root, "com:publicationTime", iso_from_time(lanes["end"].max()))
    creator = SubElement(root, "com:publicationCreator")
    _add(creator, "com:country", publisher[0])
    _add(creator, "com:nationalIdentifier", publisher[1])
    return root


def _add_header(root: Element) -> None:
    _add(SubElement(root, "roa:headerInformation"), "com:informationStatus", "real")


def _add(parent: Element, name: str, value: object, **attributes: str) -> None:
    SubElement(parent, name, attributes).text = _NO_XML.sub("\ufffd", str(value))
