#!/bin/sh
# Get Mosquitto, the broker, for the checks of the live system and `make live-demo`: see tools/get_by_apt.sh.
set -eu
cd "$(dirname "$0")"
exec sh ./get_by_apt.sh Mosquitto "1 MB" mosquitto mosquitto
