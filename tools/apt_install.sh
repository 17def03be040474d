#!/bin/sh
# Install packages by apt, as root, from the mirror that this machine's apt uses already. Simultaneous
# calls wait for each other.
#
#   tools/apt_install.sh LOG PACKAGE...    apt's output goes to the file LOG
set -eu
log=$1
shift
if command -v flock >/dev/null 2>&1 && [ -d /var/lib/dpkg ]; then
    exec 9</var/lib/dpkg
    flock 9
fi
{
    apt-get update -qq || true # one bad source may not matter
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"
} >"$log" 2>&1 8<&- 9<&- # a service that it starts would keep the locks
