"""The look of heat maps: classes, ramp, and styles for other programs."""

from __future__ import annotations

import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from gis_radar.dataset import footprint_style
from gis_radar.products.heatmap import style
from gis_radar.products.heatmap.layers import BEGIN, END
from gis_radar.products.heatmap.picture import STRIPE
from gis_radar.products.traffic_style import SHADES


def lightness(colour: str) -> float:
    """CIE L* of an sRGB colour, 0 to 100."""
    parts = np.array(list(bytes.fromhex(colour[1:]))) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    return float(116 * np.cbrt(luminance) - 16)


def test_classes_cover_zero_to_one_without_gap():
    levels = style.colour_classes()
    assert (levels[0].lower, levels[0].upper) == (0.0, 0.0)
    assert levels[1].lower == 0.0
    assert levels[-1].upper == 1.0
    assert all(one.upper == two.lower for one, two in pairwise(levels[1:]))
    assert len({level.colour for level in levels}) == len(levels)


def test_darker_is_busier_in_even_steps():
    light = [lightness(level.colour) for level in style.colour_classes()]
    steps = -np.diff(light)
    assert (steps > 7.0).all()
    assert steps.max() < 2 * steps.min()


def test_volumes_have_colours_of_their_own_in_even_steps():
    assert not set(SHADES) & set(style.RAMP)
    steps = -np.diff([lightness(colour) for colour in SHADES])
    assert (steps > 7.0).all()
    assert steps.max() < 2 * steps.min()


def test_not_observed_is_unlike_never_hit():
    assert lightness(style.NEVER_HIT) - lightness(style.NOT_OBSERVED) > 12.0


def test_road_without_vehicles_is_seen_on_the_live_page():
    page = (Path(style.__file__).parents[2] / "live" / "web" / "page.css").read_text()
    ground = lightness(re.search(r"#map {.*background: (#\w{6});", page)[1])
    assert lightness(style.NEVER_HIT) - ground > 4.0
    assert ground - lightness(style.RAMP[0]) > 4.0


def test_heavy_and_light_vehicles_are_told_apart_in_grey():
    root = ET.fromstring(footprint_style())  # noqa: S314
    light, heavy = (
        root.find(f".//symbol[@name='{name}']/layer/Option/Option[@name='color']").get("value")
        for name in ("0", "2")
    )
    shades = [lightness("#" + bytes(map(int, each.split(",")[:3])).hex())
              for each in (light, heavy)]  # fmt: skip
    assert shades[0] - shades[1] > 15.0


@pytest.mark.parametrize("interval_s", [None, 900.0])
def test_vector_qml(interval_s):
    root = ET.fromstring(style.vector_qml(interval_s=interval_s))  # noqa: S314
    renderer = root.find("renderer-v2")
    assert renderer.get("attr") == "hit_share"
    ranges = renderer.findall("ranges/range")
    assert [(float(r.get("lower")), float(r.get("upper"))) for r in ranges] == [
        (level.lower, level.upper) for level in style.colour_classes()
    ]
    symbols = renderer.findall("symbols/symbol")
    assert [symbol.get("name") for symbol in symbols] == [one.get("symbol") for one in ranges]
    fills = [symbol.find(".//Option[@name='color']").get("value") for symbol in symbols]
    assert fills == [rgba(each.colour) for each in style.colour_classes()]
    temporal = root.find("temporal")
    if interval_s:
        assert (temporal.get("startField"), temporal.get("endField")) == (BEGIN, END)
        assert (temporal.get("mode"), temporal.get("limitMode")) == ("1", "0")
        assert (temporal.get("fixedDuration"), temporal.get("durationUnit")) == ("899990", "ms")
    else:
        assert temporal is None


def rgba(colour):
    return ",".join(map(str, [*bytes.fromhex(colour[1:]), 255]))


def test_the_ground_has_the_colour_of_what_is_not_observed_and_its_stripes():
    qml = style.ground_qml(style.vector_qml())
    fill, hatch = ET.fromstring(qml).findall(".//symbols/symbol/layer")  # noqa: S314
    colours = [
        {one.get("value") for one in each.iter("Option") if str(one.get("name")).endswith("color")}
        for each in (fill, hatch)
    ]
    assert colours == [{rgba(style.NOT_OBSERVED)}, {rgba(STRIPE)}]


def test_a_pixel_on_a_break_has_the_class_of_its_tile():
    items = ET.fromstring(style.sidecar_qml()).findall(".//colorrampshader/item")  # noqa: S314
    for item, level in zip(items, style.colour_classes(), strict=True):
        assert float(item.get("value")) == float(np.float32(level.upper))


def test_classes_need_the_standard_library_only():
    code = f"import runpy; print(len(runpy.run_path({style.__file__!r})['colour_classes']()))"
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout == "9\n"
