"""References to a thing by any of its names lead to where the pages document it.

`gis_radar.hdmap.tiles.read_tiles` leads to `gis_radar.read_tiles`.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

import gis_radar


def setup(app: Sphinx) -> dict[str, Any]:
    """Look unknown names up among the public ones."""
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.Node | None:
    """Return a reference to what `node` names, by another of its names."""
    if node.get("refdomain") != "py":
        return None
    domain = env.domains.python_domain
    for name in other_names(node.get("reftarget", "")):
        if name in domain.objects:
            refdoc = node["refdoc"]
            return domain.resolve_xref(env, refdoc, app.builder, "obj", name, node, content)
    return None


def other_names(target: str) -> Iterator[str]:
    """Yield the public name of a thing, that in its room, and the name where it is defined."""
    parts = target.split(".")
    for cut in range(len(parts) - 1, 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        thing = getattr(module, parts[cut], None)
        if thing is None:
            return
        rest = parts[cut + 1 :]
        for public in dir(gis_radar):
            if inspect.unwrap(getattr(gis_radar, public)) is thing:  # functions are checked there
                yield ".".join(["gis_radar", public, *rest])
        if hasattr(thing, "__qualname__"):
            room = thing.__module__.split(".")[:2]
            yield ".".join([*room, thing.__qualname__, *rest])
            yield ".".join([thing.__module__, thing.__qualname__, *rest])
        return
