#!/bin/sh
# Get Mosquitto, the broker, for the checks of the live system and `make live-demo`, on Debian as
# root, from the mirror that this machine's apt uses already. Where it is there, this says nothing.
#
#   tools/get_mosquitto.sh     where it cannot be had, one line says why, and the exit code is 1
set -eu

fail() {
    echo "Mosquitto: not tested: $*" >&2
    exit 1
}

is_debian() {
    # shellcheck source=/dev/null
    [ -r /etc/os-release ] && (. /etc/os-release && [ "${ID:-}" = debian ])
}

is_there() {
    PATH="$PATH:/usr/sbin" command -v mosquitto >/dev/null
}

if is_there; then
    exit 0
fi
is_debian || fail "it is fetched on Debian only"
[ "$(id -u)" -eq 0 ] || fail "it is not installed, and that needs root"
echo "set-up: installing Mosquitto by apt (1 MB, once)."
log=$(mktemp)
trap 'rm -f "$log"' EXIT
{
    apt-get update -qq || true # one bad source need not matter
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends mosquitto
} >"$log" 2>&1 || fail "apt could not install it ($(sed -n 's/^E: *//p' "$log" | head -n 1))"
is_there || fail "apt installed none that is found"
