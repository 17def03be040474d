"""Mistakes that analysts make in Python: each is refused in one line that says what is wanted."""

import inspect
import pickle
import pkgutil
import re
from datetime import date, timedelta
from types import FunctionType

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from datasets import recordings_of, write_dataset
from doc_pages import DOCS

import gis_radar as gr
from gis_radar.base import GisRadarError, require_kind, require_kinds

UTM = "EPSG:25832"
OTHERS = [
    ["a", 5], [None], {"a": object()}, object(), b"abc", np.array(["a"]), timedelta(minutes=15),
    pd.DataFrame({"a": [1]}), gpd.GeoDataFrame(geometry=[shapely.Point(0, 0)], crs=4326),
]  # fmt: skip
PLACE = {"easting": 690_356.0, "northing": 5_336_183.0}
POSE = {"sensor": "R1", "crs": UTM, **PLACE, "height": 370.0, "yaw": 0.0, "pitch": 0.0, "roll": 0.0}


def functions() -> list[str]:
    return [name for name in gr.__all__ if isinstance(getattr(gr, name), FunctionType)]


@pytest.mark.parametrize("name", functions())
def test_an_argument_of_a_wrong_kind_is_refused_by_name(name):
    function = getattr(gr, name)
    parameters = inspect.signature(function).parameters
    needed = [each for each, it in parameters.items() if it.default is it.empty]
    for value in OTHERS if needed else []:
        with pytest.raises(GisRadarError, match=rf"{name}: \w+ is .*, expected|holds no lanes"):
            function(**dict.fromkeys(needed, value))


def is_list_only(parameter):
    annotation = str(parameter.annotation)
    try:
        require_kind("it", "R1.csv", annotation)
    except gr.UsageError:
        return "Sequence[" in annotation or "Collection[" in annotation
    return False


def takers_of_lists():
    """Give the functions and methods of the page on Python that take a list and no single text."""
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    for name in re.findall(r"auto(?:class|function):: ([\w.]+)", page):
        found = pkgutil.resolve_name(name)
        own = vars(found).values() if isinstance(found, type) else [found]
        for each in own:
            if not isinstance(each, FunctionType) or each.__name__.startswith("_"):
                continue
            if any(map(is_list_only, inspect.signature(each).parameters.values())):
                yield each


@pytest.mark.parametrize("function", [*takers_of_lists()], ids=lambda each: each.__qualname__)
def test_a_text_is_not_taken_letter_by_letter(function):
    parameters = inspect.signature(function).parameters
    given = [
        name for name, each in parameters.items()
        if each.default is each.empty or is_list_only(each)
    ]  # fmt: skip
    with pytest.raises(gr.UsageError, match=rf"{function.__name__}: \w+ is 'R1.csv', expected"):
        function(**dict.fromkeys(given, "R1.csv"))


def test_other_processes_find_a_public_function_under_its_public_name():
    assert pickle.loads(pickle.dumps(gr.measure)) is gr.measure  # noqa: S301 - our own


def test_too_few_arguments_are_told_by_python():
    with pytest.raises(TypeError, match=r"measure\(\) missing"):
        gr.measure()


@pytest.mark.parametrize("of", [gr.Dataset, gr.City])
def test_a_query_is_a_text(of):
    with pytest.raises(gr.UsageError, match="query: sql is 3, expected a text"):
        of.query(None, 3)


@pytest.mark.parametrize(
    ("annotation", "good", "bad"),
    [
        ("float", [1, 1.5, np.float32(2.0)], ["1", True, float("nan"), None]),
        ("int | None", [1, np.int64(2), None], [1.0, "1", True]),
        ("bool", [True, np.True_], [1, "yes"]),
        ("str | Path", ["a"], [["a"], 5, None]),
        ("Sequence[str | Path]", [["a"], ("a", "b"), pd.Series(["a"]), []], ["a", [5], {"a": 1}]),
        ("tuple[float, float] | None", [(1.0, 2), [1, 2], None], [(1, 2, 3), ("a", 1.0), 5]),
        ("Mapping[str, float]", [{}], [[], "a"]),
        ("Floats | str | Path", [np.zeros((2, 3)), "a"], [[[1.0, 2.0, 3.0]], 5]),
        ("gpd.GeoDataFrame", [OTHERS[-1]], [OTHERS[-2], "a"]),
        ("Any", [object(), None], []),
    ],
)
def test_a_kind_follows_from_the_annotation(annotation, good, bad):
    for value in good:
        require_kind("it", value, annotation)
    for value in bad:
        with pytest.raises(gr.UsageError, match=r"it is .*, expected "):
            require_kind("it", value, annotation)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"easting": "a"}, "pose of R1: easting is 'a', expected a number"),
        ({"height": float("nan")}, "pose of R1: height is nan, expected a number"),
        ({"view": (120, 30)}, r"pose of R1: view is \(120, 30\), expected View or None"),
        ({"crs": 4326}, "geographic"),
        ({"crs": True}, "not a known coordinate system"),
    ],
)
def test_fields_of_a_pose(change, told):
    with pytest.raises(gr.InputError, match=told):
        gr.Pose(**{**POSE, **change})


def test_fields_of_views_filters_and_labels():
    for made, options in [
        (gr.View, {"azimuth_deg": "wide"}), (gr.Filters, {"clearance": (1.0, 2.0, 3.0)}),
        (gr.Filters, {"sigmas": float("nan")}), (gr.MapLabels, {"title": 5}),
    ]:  # fmt: skip
        with pytest.raises(GisRadarError, match=f"{made.__name__}: .* expected"):
            made(**options)
    require_kinds(gr.View())


@pytest.mark.parametrize("points", ["north", 5, [1.0, 2.0, 3.0], np.zeros((3, 2)), [["a", 1, 2]]])
def test_points_are_rows_of_three_numbers(points):
    pose = gr.Pose(**POSE)
    for take in (pose.to_map, pose.to_sensor, gr.View().sees):
        with pytest.raises(gr.UsageError, match="expected an array of n rows"):
            take(points)


@pytest.mark.parametrize(
    ("bearing", "place", "told"),
    [
        ("northwards", PLACE, "neither degrees nor one of"),
        (90.0, {"easting": 11.56, "northing": 48.14}, "outside the area"),
        (90.0, {"easting": 5_336_183.0, "northing": 690_356.0}, "outside the area"),
    ],
)
def test_a_bearing_at_a_place_that_is_none(bearing, place, told):
    with pytest.raises(GisRadarError, match=told):
        gr.yaw_from_compass(bearing, UTM, **place)


def test_a_bearing_may_be_a_word():
    at = {"crs": UTM, **PLACE}
    assert gr.yaw_from_compass("north-east", **at) == gr.yaw_from_compass(45.0, **at)


def test_tables_that_hold_no_tiles(tmp_path):
    table = OTHERS[-1]
    for use in (lambda: gr.write_tiles(table, tmp_path / "t.gpkg"),
                lambda: gr.find_sight(gr.Pose(**POSE), table)):  # fmt: skip
        with pytest.raises(gr.InputError, match="tiles lacks tile_id"):
            use()
    assert not list(tmp_path.iterdir())


def test_steps_and_sensors_that_a_dataset_has_not(tmp_path):
    measured = write_dataset(tmp_path, recordings=recordings_of({"R1": "a"}), hours=[485_000])
    for seconds in (1_749_713_400, 1_749_713_400_000, True):
        for question in ({"begin": seconds}, {"end": seconds}):
            with pytest.raises(gr.UsageError, match="is no step of 50 ms"):
                measured.hits(**question)
    with pytest.raises(gr.UsageError, match="has no sensor 'R9'"):
        measured.sight_of("R9")


@pytest.mark.parametrize("period", [5, None, date(2026, 9, 7), ("2026-09-07",), ["a", "b", "c"]])
def test_periods_that_are_none(period):
    with pytest.raises(gr.UsageError, match="is no period"):
        gr.compare("nowhere", before=period, after=period)
