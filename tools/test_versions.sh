#!/bin/sh
# Run a part of the tests with other versions than those that constraints.txt pins.
#
#   tools/test_versions.sh lowest  the lowest version of each requirement that pyproject.toml allows
#   tools/test_versions.sh newest  the newest version of each
#
# They run in an environment of their own, out/versions/NAME. Warnings are ignored: old libraries warn
# of newer ones. Left out are tests of QGIS, the demo, a browser, and large packages.
set -eu
cd "$(dirname "$0")/.."

name=${1:-}
case $name in
lowest) resolution=lowest-direct ;;
newest) resolution=highest ;;
*) echo "test-versions: what is \"$name\"? Give lowest or newest." >&2 && exit 2 ;;
esac
parts="same_bytes hostile_tables tiles pose osm projection formats_bags formats_captures
    formats_pcd formats_tables heatmap_files heatmap_raster scans mask report_pages
    geopackage_styles qgis_project site_file"
tools="pytest pytest-timeout hypothesis dpkt python-pcapng pypdf"
venv=out/versions/$name
uv=.venv/bin/uv

$uv venv --quiet --clear --python .venv/bin/python "$venv"
$uv pip compile --quiet --no-header --no-annotate --resolution $resolution --only-binary :all: \
    --extra pdf --output-file "$venv/requirements.txt" pyproject.toml
$uv pip install --quiet --python "$venv/bin/python" --only-binary :all: -r "$venv/requirements.txt"
# shellcheck disable=SC2086 # one word a package
$uv pip install --quiet --python "$venv/bin/python" --constraints "$venv/requirements.txt" $tools
$uv pip install --quiet --python "$venv/bin/python" --no-deps --editable .
sed 's/^/test-versions: /' "$venv/requirements.txt"
files=tests/fuzz
for part in $parts; do
    files="$files tests/test_$part.py"
done
# shellcheck disable=SC2086 # one word a file
exec "$venv/bin/python" -m pytest -p no:cacheprovider -o filterwarnings=ignore $files
