"""A PostgreSQL server with PostGIS in a temporary folder: a socket, no port."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

INITDB = max(Path("/usr/lib/postgresql").glob("*/bin/initdb"), default=None)
POSTGIS = next(Path("/usr/share/postgresql").glob("*/extension/postgis.control"), None)

needs_postgis = pytest.mark.skipif(
    INITDB is None or POSTGIS is None, reason="PostgreSQL with PostGIS is not installed"
)


@contextmanager
def server():
    """Run a server; yield the address of its database. It refuses to run as root."""
    folder = Path(tempfile.mkdtemp(prefix="pg"))  # sockets have short names
    owner = pwd.getpwnam("postgres") if os.geteuid() == 0 else None
    if owner:
        os.chown(folder, owner.pw_uid, owner.pw_gid)
    user = {"user": owner.pw_uid, "group": owner.pw_gid, "extra_groups": []} if owner else {}

    def call(program, *words):
        command = [INITDB.with_name(program), "-D", folder / "data", *words]
        subprocess.run(command, check=True, cwd=folder, stdout=subprocess.DEVNULL, **user)

    call("initdb", "--auth=trust", "--no-sync", "--username=postgres")
    options = f"-c listen_addresses='' -c fsync=off -k {folder}"
    call("pg_ctl", "-w", "-l", folder / "log", "-o", options, "start")
    try:
        yield f"postgresql://postgres@/postgres?host={folder}"
    finally:
        call("pg_ctl", "-w", "-m", "immediate", "stop")
        shutil.rmtree(folder, ignore_errors=True)
