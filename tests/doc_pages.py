"""The pages of the documentation as tests see them: their code, and what the package can say."""

import ast
import re
import shlex
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)


def blocks(page, language):
    """Give the blocks of code of a page in one language."""
    text = page.read_text(encoding="utf-8")
    return [code for name, code in _BLOCK.findall(text) if name == language]


def commands(page):
    """Give the calls of `gis-radar` in the blocks of shell of a page, as words."""
    lines = "\n".join(blocks(page, "sh")).replace("\\\n", " ").splitlines()
    calls = [shlex.split(line, comments=True) for line in lines if line.startswith("gis-radar ")]
    return [words[: words.index(">")] if ">" in words else words for words in calls]


@cache
def sayings():
    """Give a pattern for each text of the package, in which any value may stand for a field."""
    found = set()
    for path in sorted((ROOT / "gis_radar").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            parts = _parts(node)
            if len("".join(part for part in parts if part is not None)) >= 9:
                found.add("".join(".+?" if part is None else re.escape(part) for part in parts))
    return [re.compile(pattern, flags=re.DOTALL) for pattern in sorted(found)]


def _parts(node):
    """Give the fixed parts of a text, None for each field."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [node.value]
    if isinstance(node, ast.JoinedStr):
        return [part.value if isinstance(part, ast.Constant) else None for part in node.values]
    return []
