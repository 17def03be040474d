#!/bin/sh
# Get Chromium and its driver for the checks of the report, on Debian as root, from the mirror that
# this machine's apt uses already. Where it is there, this says nothing.
#
#   tools/get_chromium.sh      where it cannot be had, one line says why, and the exit code is 1
set -eu

fail() {
    echo "Chromium: not tested: $*" >&2
    exit 1
}

is_debian() {
    # shellcheck source=/dev/null
    [ -r /etc/os-release ] && (. /etc/os-release && [ "${ID:-}" = debian ])
}

is_there() {
    command -v chromium >/dev/null && command -v chromedriver >/dev/null
}

if is_there; then
    exit 0
fi
is_debian || fail "chromium and chromedriver are fetched on Debian only"
[ "$(id -u)" -eq 0 ] || fail "chromium or chromedriver is not installed, and that needs root"
echo "set-up: installing Chromium by apt (100 MB, once; about half a minute)."
log=$(mktemp)
trap 'rm -f "$log"' EXIT
{
    apt-get update -qq || true # one bad source need not matter
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        chromium chromium-driver
} >"$log" 2>&1 || fail "apt could not install Chromium ($(sed -n 's/^E: *//p' "$log" | head -n 1))"
is_there || fail "apt installed no Chromium that is found"
