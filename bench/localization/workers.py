"""Workers: the processes that share the work, a thread each."""

from __future__ import annotations

import multiprocessing
import os
from multiprocessing.pool import Pool

PROCESSES = 2
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def workers(processes: int = PROCESSES) -> Pool:
    """Return a pool of new processes; libraries that begin threads of their own begin one."""
    for name in THREADS:
        os.environ.setdefault(name, "1")
    return multiprocessing.get_context("spawn").Pool(processes)
