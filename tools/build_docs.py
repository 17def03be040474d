"""Build the documentation; a warning is an error.

    python tools/build_docs.py [--run-notebooks] [FOLDER]

`docs` and `notebooks` are copied to FOLDER/source first, so that nothing is generated in the tree;
the pages are FOLDER/html. FOLDER is out/docs by default.
"""

from __future__ import annotations

import gc
import shutil
import sys
from pathlib import Path

from sphinx.cmd.build import main as build

ROOT = Path(__file__).parents[1]


def main(arguments: list[str]) -> int:
    """Build the site, and return the exit code."""
    run = "--run-notebooks" in arguments
    folders = [argument for argument in arguments if not argument.startswith("-")]
    folder = Path(folders[0]) if folders else ROOT / "out" / "docs"
    stage(folder / "source")
    mode = "auto" if run else "off"
    gc.disable()  # saves a fifth of the time: the trees of all pages are kept until the end anyway
    code = build(
        ["-b", "html", "-W", "--keep-going", "-q", "-D", f"nb_execution_mode={mode}",
         "-d", str(folder / "doctrees"), str(folder / "source"), str(folder / "html")]
    )  # fmt: skip
    if code == 0:
        print(f"wrote {folder / 'html' / 'index.html'}")
    return code


def stage(folder: Path) -> None:
    """Copy all pages to a folder, and delete there what the sources no longer have."""
    sources = {
        Path(name): path
        for root, below in ((ROOT / "docs", ""), (ROOT / "notebooks", "notebooks"))
        for path in sorted(root.rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts
        for name in [Path(below) / path.relative_to(root)]
    }
    sources[Path("changes.md")] = ROOT / "CHANGELOG.md"
    if folder.exists():
        for path in [path for path in folder.rglob("*") if path.is_file()]:
            if path.relative_to(folder) not in sources:
                path.unlink()
    for name, path in sources.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.exists() or target.read_bytes() != path.read_bytes():
            shutil.copyfile(path, target)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
