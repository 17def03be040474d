"""The report as one HTML file: styles, script and pictures inside, and no way out."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from importlib.resources import files

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from gis_radar.heatmap import style
from gis_radar.report.canvas import Picture, image_of, png
from gis_radar.report.content import Content, MapPart


def page_of(content: Content) -> str:
    """Return the page; all text of others is escaped, and the policy lets nothing else in."""
    css, script = _part("page.css") + _legend_css() + _map_css(content.map), _part("page.js")
    return _template().render(
        report=content,
        levels=style.colour_classes(),
        legend_title=style.LEGEND_TITLE,
        not_observed=style.NOT_OBSERVED_LABEL,
        css=Markup(css),  # noqa: S704 - our own file
        script=Markup(script),  # noqa: S704 - our own file
        policy=_policy(css, script),
        data_uri=_data_uri,
        picture_uri=_picture_uri,
    )


def _policy(css: str, script: str) -> str:
    """Return the Content-Security-Policy: pictures in the page, our style, our script."""
    return (
        "default-src 'none'; img-src data:; "
        f"style-src '{_hash(css)}'; script-src '{_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _legend_css() -> str:
    """Return the colours of the legend, which are those of the maps."""
    rules = [
        f".level-{i} {{ background: {level.colour}; }}"
        for i, level in enumerate(style.colour_classes())
    ]
    return "\n".join(rules) + "\n"


def _map_css(part: MapPart) -> str:
    """Return how large the map may be: whole in the window, and beside its words on paper."""
    shape = f"{part.width} / {part.height}"
    return (
        "@media screen and (min-width: 52rem) { .plate { grid-template-columns: "
        f"minmax(0, calc(max(22rem, min(58rem, 88vh)) * {shape})) 18rem; }} }}\n"
        f"@media print {{ .large .sheet {{ max-width: calc(116mm * {shape}); }} }}\n"
    )


def _data_uri(picture: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(picture).decode()


def _picture_uri(picture: Picture) -> str:
    return _data_uri(png(image_of(picture)))


@cache
def _template() -> Template:
    text = _part("page.html")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(text)


def _part(name: str) -> str:
    return files("gis_radar.report").joinpath(name).read_text(encoding="utf-8")
