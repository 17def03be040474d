#!/bin/sh
# Get MapLibre GL JS (BSD-3-Clause), which draws the page of the live map, by npm.
# Prints nothing where it is there.
#
#   tools/get_maplibre.sh      where it cannot be had, one line says why, and the exit code is 1
set -eu
cd "$(dirname "$0")/.."

version=6.17.0
sum=587807d8d6c99349022e027fa310c16cfaa55392131f6263df080306db6809b0
place=gis_radar/live/web/vendor

fail() {
    echo "MapLibre: not fetched: $*" >&2
    exit 1
}

[ "$(cat $place/version 2>/dev/null || true)" != $version ] || exit 0
command -v npm >/dev/null || fail "npm is not installed"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
(cd "$work" && npm pack --silent "maplibre-gl@$version" >log 2>&1) ||
    fail "npm did not deliver it ($(head -n 1 "$work/log"))"
echo "$sum  $work/maplibre-gl-$version.tgz" | sha256sum --check --quiet >/dev/null 2>&1 ||
    fail "the package has another checksum than the one of version $version that was reviewed"
tar xzf "$work/maplibre-gl-$version.tgz" -C "$work"
rm -rf $place
mkdir -p $place
for name in maplibre-gl.mjs maplibre-gl-worker.mjs maplibre-gl-shared.mjs maplibre-gl.css; do
    cp "$work/package/dist/$name" $place/
done
cp "$work/package/LICENSE.txt" $place/
echo $version >$place/version
