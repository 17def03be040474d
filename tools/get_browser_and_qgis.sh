#!/bin/sh
# Get the programs of the checks: MapLibre, Mosquitto, PostGIS, Chromium and QGIS, one after the other.
# A program that cannot be had is left out; with GIS_RADAR_CHROMIUM=required (..._MOSQUITTO, ..._POSTGIS) that is a failure.
#
#   tools/get_browser_and_qgis.sh --apt    only what apt installs, which needs no .venv
set -eu
cd "$(dirname "$0")/.."
if command -v flock >/dev/null 2>&1; then # another call may be running
    exec 8<tools
    flock 8
fi
[ "${1:-}" = --apt ] || sh tools/get_maplibre.sh || [ "${GIS_RADAR_CHROMIUM:-}" != required ]
sh tools/get_mosquitto.sh || [ "${GIS_RADAR_MOSQUITTO:-}" != required ]
sh tools/get_postgis.sh || [ "${GIS_RADAR_POSTGIS:-}" != required ]
sh tools/get_chromium.sh || [ "${GIS_RADAR_CHROMIUM:-}" != required ]
sh tools/get_qgis.sh "$@" 2>/dev/null || true # tools/test_qgis.sh says why
