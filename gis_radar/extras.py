"""Optional dependencies: which command installs them."""

from __future__ import annotations

LOCALIZE = "pip install gis_radar[localize]"
NOTEBOOKS = "pip install gis_radar[notebooks]"
