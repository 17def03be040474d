"""`python -m gis_radar`: the same as the command `gis-radar`."""

from gis_radar.cli import main

main()
