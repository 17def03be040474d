#!/bin/sh
# Get programs for the checks, on Debian as root, from the mirror that this machine's apt uses
# already. Prints nothing where they are installed.
#
#   tools/get_by_apt.sh NAME SIZE "PROGRAM..." "PACKAGE..."
#
# Where they cannot be had, one line says why, and the exit code is 1.
set -eu
name=$1 size=$2 programs=$3 packages=$4

fail() {
    echo "$name: not tested: $*" >&2
    exit 1
}

is_debian() {
    # shellcheck source=/dev/null
    [ -r /etc/os-release ] && (. /etc/os-release && [ "${ID:-}" = debian ])
}

are_there() {
    for program in $programs; do
        PATH="$PATH:/usr/sbin" command -v "$program" >/dev/null || return 1
    done
}

if are_there; then
    exit 0
fi
is_debian || fail "it is fetched on Debian only"
[ "$(id -u)" -eq 0 ] || fail "it is not installed, and that needs root"
echo "set-up: installing $name by apt ($size, once)."
log=$(mktemp)
trap 'rm -f "$log"' EXIT
# shellcheck disable=SC2086 # a word a package
sh "$(dirname "$0")/apt_install.sh" "$log" $packages ||
    fail "apt could not install it ($(sed -n 's/^E: *//p' "$log" | head -n 1))"
are_there || fail "apt installed none that is found"
