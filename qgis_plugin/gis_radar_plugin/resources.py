"""Files that the plugin shares with gis_radar: one copy in git, one more in the plugin's zip."""

from __future__ import annotations

from pathlib import Path

from qgis.PyQt.QtXml import QDomDocument

HERE = Path(__file__).resolve().parent


def shared_document(name: str) -> QDomDocument:
    """Read a style of gis_radar: of the installed plugin, or the checkout around it.

    Parameters
    ----------
    name : str
        From the folder of the package, as tools/plugin_zip.py lists it.
    """
    installed = HERE / "resources" / name
    path = installed if installed.is_file() else HERE.parents[1] / "gis_radar" / name
    document = QDomDocument()
    document.setContent(path.read_text(encoding="utf-8"))
    return document
