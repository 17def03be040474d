"""The example at the end of a command's help becomes a block of code."""

from __future__ import annotations

from typing import Any

from sphinx.application import Sphinx

EXAMPLE = "Example: "


def setup(app: Sphinx) -> dict[str, Any]:
    """Rewrite the last lines of each command."""
    app.connect("sphinx-click-process-epilog", rewrite)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def rewrite(_app: Sphinx, _context: Any, lines: list[str]) -> None:
    """Turn `Example: CALL` into a block; what else there is stays."""
    text = " ".join(line.strip() for line in lines if line.strip())
    if text.startswith(EXAMPLE):
        lines[:] = [
            "Example:",
            "",
            ".. code-block:: sh",
            "",
            "   " + text.removeprefix(EXAMPLE),
            "",
        ]
