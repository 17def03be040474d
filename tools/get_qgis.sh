#!/bin/sh
# Get QGIS 3.40 for the checks of the plugin, on Debian 12 as root: from the backports suite of the
# mirror that this machine's apt uses already. Prints nothing where it is installed.
#
#   tools/get_qgis.sh          where it cannot be had, one line says why, and the exit code is 1
#   tools/get_qgis.sh --apt    only what apt installs, which needs no .venv
set -eu
cd "$(dirname "$0")/.."

venv=.qgis
wanted="python3-qgis qgis xvfb xauth imagemagick openbox x11-utils fonts-dejavu-core
    fonts-open-sans python3-venv"

fail() {
    echo "QGIS: not tested: $*" >&2
    exit 1
}

is_debian_12() {
    # shellcheck source=/dev/null
    [ -r /etc/os-release ] && (. /etc/os-release && [ "${ID:-}:${VERSION_ID:-}" = debian:12 ])
}

qgis_is_new_enough() {
    PATH=/usr/sbin:/usr/bin:/sbin:/bin QT_QPA_PLATFORM=offscreen \
        /usr/bin/python3 -c 'from qgis.core import Qgis; raise SystemExit(Qgis.QGIS_VERSION_INT < 33400)' \
        >/dev/null 2>&1 && [ -x /usr/bin/qgis_process ]
}

all_is_there() {
    qgis_is_new_enough && [ -x "$(command -v Xvfb)" ] && [ -x "$(command -v import)" ] &&
        [ -x "$(command -v openbox)" ]
}

# Writes this machine's apt entries for Debian 12 with the backports suite instead, mirror and keys
# unchanged, into a file of their own, which is removed afterwards.
backports_sources() {
    cat /etc/apt/sources.list /etc/apt/sources.list.d/*.list 2>/dev/null | awk '
        $1 == "deb" {
            for (i = 2; i <= NF; i++) if ($i == "bookworm") { $i = "bookworm-backports"; print; next }
        }' | sort -u >"$1.list"
    for file in /etc/apt/sources.list.d/*.sources; do
        [ -r "$file" ] || continue
        awk -v RS= '
            {
                n = split($0, line, "\n")
                entry = ""
                fits = 0
                for (i = 1; i <= n; i++) {
                    if (line[i] ~ /^#/) continue
                    if (line[i] ~ /^Suites:/) {
                        fits = (line[i] " ") ~ /[: ]bookworm /
                        line[i] = "Suites: bookworm-backports"
                    }
                    entry = entry line[i] "\n"
                }
                if (fits) print entry
            }' "$file"
    done >"$1.sources"
    [ -s "$1.list" ] || rm "$1.list"
    [ -s "$1.sources" ] || rm "$1.sources"
    [ -e "$1.list" ] || [ -e "$1.sources" ]
}

install() {
    added=/etc/apt/sources.list.d/gis-radar-qgis
    pinned=/etc/apt/preferences.d/gis-radar-qgis
    log=$(mktemp)
    trap 'rm -f "$log" $added.list $added.sources $pinned' EXIT
    if ! apt-cache policy qgis | grep -q bookworm-backports; then
        backports_sources $added || fail "apt knows no source of Debian 12's packages here"
    fi
    # Only QGIS comes from backports: a whole suite would bring more.
    printf 'Package: src:qgis\nPin: release n=bookworm-backports\nPin-Priority: 990\n' >$pinned
    echo "set-up: installing QGIS by apt (250 MB, once; about a minute)."
    # shellcheck disable=SC2086 # one word a package
    sh tools/apt_install.sh "$log" $wanted ||
        fail "apt could not install QGIS ($(sed -n 's/^E: *//p' "$log" | head -n 1))"
}

# Python for the tests: QGIS's own with pytest, without geographic wheels.
make_venv() {
    requirements=qgis_plugin/tests/requirements.txt
    if [ -x $venv/bin/pytest ] && cmp -s $requirements $venv/requirements.txt &&
        grep -qF "$(pwd -P)/$venv" $venv/bin/activate; then
        return
    fi
    uv=${GIS_RADAR_UV:-.venv/bin/uv}
    if [ -x "$uv" ]; then # installing pip takes ten seconds more
        /usr/bin/python3 -m venv --clear --without-pip --system-site-packages $venv &&
            "$uv" pip install --quiet --compile-bytecode --python $venv/bin/python -r $requirements
    else
        /usr/bin/python3 -m venv --clear --system-site-packages $venv &&
            $venv/bin/python -m pip install --quiet --disable-pip-version-check -r $requirements
    fi || fail "pytest-qgis could not be installed into $venv (see above)"
    cp $requirements $venv/requirements.txt
}

if ! all_is_there; then
    is_debian_12 || fail "QGIS is fetched on Debian 12 only"
    [ "$(id -u)" -eq 0 ] || fail "QGIS is not installed, and that needs root"
    install
    qgis_is_new_enough || fail "apt installed a QGIS that does not run"
fi
[ "${1:-}" = --apt ] || make_venv
