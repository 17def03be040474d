"""The pages of the documentation as tests see them: their code, and what the package can say."""

import re
import shlex
from functools import cache
from pathlib import Path

from tools.catalogue import shown

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
    """Give a pattern for each text of the package, in which any value may stand in a hole."""
    parts = [re.split(r"\{[^}]*\}", text) for text in shown()[0]]
    found = {".+?".join(map(re.escape, each)) for each in parts if len("".join(each)) >= 9}
    return [re.compile(pattern, flags=re.DOTALL) for pattern in sorted(found)]
