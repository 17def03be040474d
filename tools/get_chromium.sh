#!/bin/sh
# Get Chromium and its driver, for the checks of pages: see tools/get_by_apt.sh.
set -eu
cd "$(dirname "$0")"
exec sh ./get_by_apt.sh Chromium "100 MB, half a minute" "chromium chromedriver" "chromium chromium-driver"
