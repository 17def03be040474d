#!/bin/sh
# Get Debian 11's PDAL into .pdal for the tests, on Debian 12, which has no package of it.
#
# Only the tests run it: Debian 11 is no longer supported. The packages come from the mirror that
# this machine's apt uses already, and apt checks their signatures, in a folder of its own: the
# system is not changed, and root is not needed. The program runs with the loader and libraries of
# Debian 11. Where it cannot be had, one line says why, and tests of PDAL are skipped.
set -eu
cd "$(dirname "$0")/.."

give_up() {
    echo "set-up: no PDAL for the tests: $*" >&2
    exit 0
}

[ ! -x .pdal/bin/pdal ] || exit 0
[ -z "${GIS_RADAR_PDAL:-}" ] && ! command -v pdal >/dev/null 2>&1 || exit 0 # the user's own
# shellcheck source=/dev/null
[ -r /etc/os-release ] && (. /etc/os-release && [ "${ID:-}:${VERSION_ID:-}" = debian:12 ]) ||
    give_up "it is fetched on Debian 12 only; conda has it (environment.yml)"

umask 022
build=$(mktemp -d "$PWD/.pdal.part.XXXXXX")
trap 'rm -rf "$build"' EXIT
trap 'exit 130' INT TERM HUP
chmod 755 "$build" # apt's own user reads there
mkdir -p "$build/apt/lists/partial" "$build/apt/archives/partial" "$build/pdal/bin"
: >"$build/apt/status"

private_apt() {
    LC_ALL=C timeout --foreground 600 apt-get -q -o Dir::State="$build/apt" \
        -o Dir::State::status="$build/apt/status" -o Dir::Cache="$build/apt" \
        -o Dir::Etc::sourcelist="$build/apt/sources.list" -o Dir::Etc::sourceparts=/dev/null \
        -o APT::Default-Release= -o APT::Install-Recommends=false -o Acquire::Retries=2 \
        -o Acquire::AllowInsecureRepositories=false -o APT::Get::AllowUnauthenticated=false \
        "$@" >>"$build/log" 2>&1 </dev/null
}

give_up_as_apt_says() {
    give_up "$(sed -n 's/^[EW]: *//p' "$build/log" | head -n 1 | cut -c 1-200)"
}

apt-get --print-uris update 2>/dev/null |
    sed -n "s|^'\(.*\)/dists/bookworm/main/binary-.*|deb \1 bullseye main|p" |
    sort -u >"$build/apt/sources.list"
[ -s "$build/apt/sources.list" ] || give_up "apt knows no source of Debian 12's packages here"
private_apt update -eany || give_up_as_apt_says
echo "set-up: fetching PDAL into .pdal for the tests (70 MB, once; about 10 s)."
private_apt install --yes --download-only pdal || give_up_as_apt_says
for package in "$build"/apt/archives/*.deb; do
    dpkg -x "$package" "$build/pdal" || give_up "a package cannot be unpacked"
done
(cd "$build/pdal" && rm -rf bin/* etc var sbin usr/sbin usr/share/doc usr/share/locale usr/lib/*/gconv)

triplet=$(basename "$(dirname "$build"/pdal/lib/*/ld-[0-9]*.so)")
loader=$(basename "$build"/pdal/lib/*/ld-[0-9]*.so)
cat >"$build/pdal/bin/pdal" <<END
#!/bin/sh
# PDAL under the loader, libraries and data that lie beside it, and nothing of the system's.
here=\$(dirname "\$(dirname "\$(readlink -f "\$0")")")
libraries=\$here/usr/lib
for folder in usr/lib/$triplet lib/$triplet usr/lib/$triplet/blas usr/lib/$triplet/lapack; do
    libraries=\$libraries:\$here/\$folder
done
unset LD_LIBRARY_PATH LD_PRELOAD PROJ_DATA GDAL_DRIVER_PATH
export PROJ_LIB="\$here/usr/share/proj" GDAL_DATA="\$here/usr/share/gdal"
export PDAL_DRIVER_PATH="\$here/usr/lib" GCONV_PATH="\$here/usr/lib" LC_ALL=C
exec "\$here/lib/$triplet/$loader" --library-path "\$libraries" "\$here/usr/bin/pdal" "\$@"
END
chmod 755 "$build/pdal/bin/pdal"
"$build/pdal/bin/pdal" --version >/dev/null 2>&1 || give_up "Debian 11's PDAL does not start here"
rm -rf .pdal
mv -T "$build/pdal" .pdal
