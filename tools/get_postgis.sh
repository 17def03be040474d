#!/bin/sh
# Get PostgreSQL with PostGIS for the checks of `gis-radar publish`: see tools/get_by_apt.sh.
set -eu
cd "$(dirname "$0")"
exec sh ./get_by_apt.sh PostGIS "20 MB" "shp2pgsql pg_config" "postgis postgresql postgresql-postgis libpq-dev"
