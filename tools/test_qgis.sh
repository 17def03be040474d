#!/bin/sh
# Test the plugin in a real QGIS: PyQGIS, qgis_process, and the desktop on a virtual screen.
#
# Where QGIS cannot be had, one line says why; with GIS_RADAR_QGIS=required that is a failure.
# Further arguments go to pytest.
set -eu
cd "$(dirname "$0")/.."

if ! sh tools/get_qgis.sh; then
    [ "${GIS_RADAR_QGIS:-}" != required ] || exit 1
    exit 0
fi
# A Python of pyenv or conda in front makes qgis_process crash.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin
export QT_QPA_PLATFORM=offscreen PYTHONDONTWRITEBYTECODE=1
export GIS_RADAR_UV="${GIS_RADAR_UV:-$PWD/.venv/bin/uv}"
export GIS_RADAR_PYTHON="${GIS_RADAR_PYTHON:-$PWD/.venv/bin/python}"
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
mkdir -m 700 "$place/run"
export XDG_RUNTIME_DIR="$place/run" QGIS_CUSTOM_CONFIG_PATH="$place/profile"
pytest=".qgis/bin/python -m pytest -c qgis_plugin/tests/pytest.ini --rootdir qgis_plugin/tests"
if [ $# -gt 0 ]; then
    $pytest "$@"
    exit 0
fi
# The results that most tests load are made once, by `make test` or here.
export GIS_RADAR_QGIS_SITE="${GIS_RADAR_DEMO:-$place/site}"
[ -n "${GIS_RADAR_DEMO:-}" ] || "$GIS_RADAR_PYTHON" -m gis_radar demo -o "$place/site" >/dev/null
# Some tests run with QGIS's library loaded first, as in the desktop, beside the rest, which run in
# one process: `make test` has other processes on the same cores.
core=$(ls /usr/lib/libqgis_core.so.3.*.* /usr/lib/*/libqgis_core.so.3.*.* 2>/dev/null | head -n 1)
(
    export LD_PRELOAD="$core"
    exec $pytest -m preload qgis_plugin/tests
) >"$place/preload.log" 2>&1 &
preload=$!
trap 'kill $preload 2>/dev/null || true; rm -rf "$place"' EXIT
trap 'exit 130' INT TERM HUP
code=0
$pytest -m "not preload" qgis_plugin/tests || code=$?
wait $preload || code=$?
echo "QGIS: tests under LD_PRELOAD=$core"
cat "$place/preload.log"
exit $code
