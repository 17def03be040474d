#!/bin/sh
# Set up .venv with pinned packages, and install the system libraries that they need.
#
#   tools/set_up.sh run    what gis-radar needs
#   tools/set_up.sh dev    also what checks and documentation need, PDAL too (tools/get_pdal.sh)
#   tools/set_up.sh bench  also the packages that the benchmarks compare with
#
# With --programs as second word, apt fetches the programs of the checks in the background.
#
# PYTHON=... names the Python to use (3.11 or newer).
# Prints nothing and uses no network where all is in place.
set -eu
cd "$(dirname "$0")/.."

level=${1:-run}
venv=.venv
stamp=$venv/.set-up-$level

fail() {
    echo "set-up: $*" >&2
    exit 1
}

is_new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1
}

can_make_venv() {
    "$1" -c 'import ensurepip, venv' >/dev/null 2>&1
}

version() {
    "$1" -c 'import sys; print(sys.version.split()[0])' 2>/dev/null || echo "not there"
}

# Finds the Python to build on: PYTHON, else the first one that is new enough, preferably one that
# can make an environment without a further package.
find_python() {
    if [ -n "${PYTHON:-}" ]; then
        is_new_enough "$PYTHON" ||
            fail "Python 3.11 or newer is needed; PYTHON=$PYTHON is $(version "$PYTHON")."
        python=$PYTHON
        return
    fi
    python=
    for name in python3.13 python3.12 python3.11 python3 python3.14; do
        is_new_enough "$name" || continue
        python=${python:-$name}
        can_make_venv "$name" || continue
        python=$name
        break
    done
    [ -n "$python" ] ||
        fail "Python 3.11 or newer is needed; python3 is $(version python3). Name another with PYTHON=..."
}

# The environment runs, was made here (its scripts hold the path), and is of the Python asked for.
venv_is_good() {
    is_new_enough $venv/bin/python && [ -x $venv/bin/pip ] || return 1
    grep -qF "$(pwd -P)/$venv" $venv/bin/activate || return 1
    [ -z "${PYTHON:-}" ] || [ "$(version "$PYTHON")" = "$(version $venv/bin/python)" ]
}

# Installs Debian packages by apt; elsewhere, or without root, one line says what is missing.
install_system() {
    [ $# -gt 0 ] || return 0
    command -v apt-get >/dev/null 2>&1 || fail "missing on this system, please install: $*"
    [ "$(id -u)" -eq 0 ] || fail "system packages are missing. As root: apt-get install $*"
    echo "set-up: installing by apt: $*"
    sh tools/apt_install.sh "$apt_log" "$@" || {
        cat "$apt_log" >&2
        fail "apt could not install: $*"
    }
}

# Lists what this machine lacks, by the names of its packages.
list_missing() {
    if ! venv_is_good && ! can_make_venv "$python"; then
        "$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'
    fi
    "$python" tools/missing_libraries.py "$level"
}

make_venv() {
    venv_is_good && return
    [ ! -L $venv ] || rm $venv # a link to another checkout's, which is not changed
    "$python" -m venv --clear $venv || fail "$python could not make $venv."
}

install_packages() {
    set -- --editable '.[pdf]'
    [ "$level" != bench ] || set -- --editable '.[localize,pdf]'
    [ "$level" = run ] || set -- "$@" --group dev --group docs
    [ "$level" != bench ] || set -- "$@" --group bench
    $venv/bin/python -m pip install --quiet --disable-pip-version-check \
        --constraint constraints.txt uv || fail "pip could not install uv (see above)."
    # Without a home to write to, downloads are kept beside what they become.
    [ -w "${HOME:-/nonexistent}" ] || export UV_CACHE_DIR=$venv/cache
    $venv/bin/uv pip install --quiet --python $venv/bin/python \
        --constraints constraints.txt --build-constraints constraints.txt "$@" ||
        fail "the packages could not be installed (see above)."
}

# Loads each package and our own modules once: this shows libraries that our list lacks, and keeps the
# compiled modules, so that later starts are fast even where nothing may be written. NUMBA_DISABLE_JIT:
# some packages compile functions when they are loaded.
check_packages() {
    PYTHONDONTWRITEBYTECODE= NUMBA_DISABLE_JIT=1 \
        $venv/bin/python tools/missing_libraries.py "$level" --load ||
        fail "a package does not load on this system (see above)."
}

case $level in
run | dev | bench) ;;
*) fail "what is \"$level\"? Give run, dev or bench." ;;
esac
apt_log=$(mktemp)
trap 'rm -f "$apt_log"' EXIT
trap 'exit 130' INT TERM HUP
state=$({
    pwd -P
    cat pyproject.toml constraints.txt tools/set_up.sh tools/missing_libraries.py
} | cksum)
if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$state" ] && venv_is_good; then
    exit 0
fi

find_python
missing=$(list_missing)
# shellcheck disable=SC2086 # one word a package
install_system $missing
# In a process group of its own, so that Ctrl-C does not leave a half-installed package.
if [ "${2:-}" = --programs ]; then
    $(command -v setsid || true) nice -n 10 sh tools/get_browser_and_qgis.sh --apt >/dev/null 2>&1 &
fi
echo "set-up: filling $venv with Python $(version "$python"); the first time takes about a minute."
make_venv
install_packages
check_packages
[ "$level" = run ] || echo "$state" >$venv/.set-up-run
[ "$level" != bench ] || echo "$state" >$venv/.set-up-dev
[ "$level" = run ] || sh tools/get_pdal.sh
echo "$state" >"$stamp"
