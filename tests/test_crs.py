import pytest
from pyproj import CRS

from gis_radar.base import (
    CrsError,
    inexact_change,
    metric_crs,
    name_of,
    require_same,
    require_true_scale,
    transformer,
    utm_zone,
)
from gis_radar.base.crs import horizontal


@pytest.mark.parametrize(
    ("place", "longitude", "latitude", "code"),
    [
        ("Ingolstadt", 11.42, 48.76, 25832),
        ("Karlsruhe", 8.4, 49.0, 25832),
        ("Lisbon", -9.14, 38.72, 25829),
        ("Bergen", 5.3, 60.4, 25832),
        ("Gibraltar", -5.35, 36.14, 25830),
        ("Athens", 23.7, 37.98, 25834),
        ("Sicily", 14.3, 37.3, 25833),
        ("Kashiwa", 139.93, 35.9, 32654),
        ("Tunis", 10.2, 36.8, 32632),
        ("Sydney", 151.2, -33.9, 32756),
        ("date line", 180.0, 10.0, 32601),
    ],
)
def test_zone_of_a_site(place, longitude, latitude, code):
    assert utm_zone(longitude, latitude).to_epsg() == code, place


@pytest.mark.parametrize(
    ("crs", "reason"),
    [
        (None, "no coordinate system"),
        ("", "no coordinate system"),
        ("EPSG:4326", "geographic"),
        ("EPSG:4258", "geographic"),
        ("EPSG:4979", "geographic"),
        ("EPSG:4978", "geocentric"),
        ("EPSG:2225", "metres are needed"),
        ("EPSG:999999", "not a known"),
        ("nonsense", "not a known"),
    ],
)
def test_unfit_systems_are_refused_by_name(crs, reason):
    with pytest.raises(CrsError, match=reason) as caught:
        metric_crs(crs, what="--crs")
    assert caught.value.message.startswith("--crs")
    assert caught.value.hint


def test_compound_and_bound_systems_count_by_their_horizontal_part():
    assert name_of(metric_crs("EPSG:25832+5783", what="scan")) == "EPSG:25832"
    assert name_of(horizontal(CRS.from_user_input("EPSG:5555"))) == "EPSG:25832"


def test_etrs89_and_wgs84_zones_are_not_the_same():
    with pytest.raises(CrsError, match=r"EPSG:25832.*EPSG:32632"):
        require_same(CRS(25832), CRS(32632), what="pose", other_what="tiles")
    require_same(CRS(25832), CRS.from_wkt(CRS(25832).to_wkt()), what="pose", other_what="tiles")


@pytest.mark.parametrize(
    ("crs", "axes"),
    [
        ("EPSG:2065", "south and west"),
        ("EPSG:2048", "west and south"),
        ("EPSG:5042", "north and north"),
        ("+proj=utm +zone=32 +axis=wsu", "west and south"),
    ],
)
def test_axes_that_do_not_point_east_and_north_are_refused(crs, axes):
    with pytest.raises(CrsError, match=f"axes that point {axes}, not east and north"):
        metric_crs(crs, what="--crs")


SITES = {
    "EPSG:25832": (11.4, 48.8),
    "EPSG:25833": (11.4, 48.8),
    "EPSG:32633": (14.0, 50.0),
    "EPSG:2154": (2.3, 48.8),
    "EPSG:28992": (4.9, 52.4),
    "EPSG:31468": (11.4, 48.8),
    "EPSG:27700": (-1.5, 52.5),
    "EPSG:2056": (7.4, 46.9),
    "EPSG:2180": (19.0, 52.0),
    "EPSG:5514": (15.0, 50.0),
    "EPSG:31256": (16.3, 48.2),
    "EPSG:3006": (15.0, 59.0),
    "EPSG:4647": (9.0, 50.0),
    "EPSG:3035": (11.4, 48.8),
    "EPSG:2193": (175.0, -41.0),
    "EPSG:6677": (139.9, 35.9),
    "EPSG:32760": (179.99, -17.0),
    "EPSG:32701": (-179.99, -17.0),
}


@pytest.mark.parametrize("crs", SITES)
def test_national_grids_are_true_to_scale_at_home(crs):
    east, north = place(crs, *SITES[crs])
    require_true_scale(metric_crs(crs, what="--crs"), east, north, what="--crs")


@pytest.mark.parametrize(
    ("crs", "site", "reason"),
    [
        ("EPSG:3857", (11.4, 48.8), "1.520 m for each metre"),
        ("EPSG:3395", (11.4, 48.8), "1.515 m for each metre"),
        ("EPSG:3857", (11.4, 0.0), "1.007 m for each metre"),
        ("EPSG:3034", (11.4, 48.8), "0.966 m for each metre"),
        ("EPSG:25831", (11.4, 48.8), "1.004 m for each metre"),
        ("EPSG:32601", (11.4, 48.8), "outside"),
        # Right across the pole the scale is true again.
        ("EPSG:32601", (3.0, 48.8), "outside"),
        ("EPSG:27700", (16.3, 48.2), "outside"),
    ],
)
def test_a_system_that_does_not_fit_the_site_is_refused_by_name(crs, site, reason):
    with pytest.raises(CrsError, match=reason) as caught:
        require_true_scale(metric_crs(crs, what="--crs"), *place(crs, *site), what="--crs")
    assert crs in caught.value.message
    assert caught.value.message.startswith("--crs")
    assert "UTM" in caught.value.hint


@pytest.mark.parametrize("easting", [float("nan"), float("inf"), 1e12])
def test_a_place_that_is_none_has_no_scale(easting):
    with pytest.raises(CrsError, match="outside"):
        require_true_scale(CRS(25832), easting, 5_400_000.0, what="--crs")


def place(crs, longitude, latitude):
    system = CRS(crs)
    return transformer(system.geodetic_crs, system).transform(longitude, latitude)


@pytest.mark.parametrize(
    ("source", "target", "place", "error"),
    [
        (3003, 25832, (1_514_000.0, 5_034_000.0), "4 m"),  # Milan: Monte Mario has no grid in PROJ
        (30169, 32654, (-10_000.0, -10_000.0), "9 m"),  # Tokyo
        (25833, 25832, (236_000.0, 5_406_000.0), ""),
        (32632, 25832, (677_900.0, 5_403_700.0), ""),
        (2154, 25831, (652_000.0, 6_862_000.0), ""),
        (4326, 25832, (11.42, 48.76), ""),
        (25832, 25832, (677_900.0, 5_403_700.0), ""),
        (3003, 25832, (float("inf"), 0.0), ""),
        (4326, 28355, (145.0, -37.8), "3 m"),  # Melbourne: GDA94 is 1.8 m off by now
        (4326, 7855, (145.0, -37.8), ""),  # GDA2020
        (4508, 32649, (500_000.0, 3_450_000.0), ""),  # CGCS2000
    ],
)
def test_a_change_between_datums_states_its_error(source, target, place, error):
    remark = inexact_change(CRS.from_epsg(source), CRS.from_epsg(target), *place)
    assert (remark or "").endswith(error)
    assert bool(remark) is bool(error)
