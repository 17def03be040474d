"""A worker's leash: it stops when the program that holds its standard input lets go.

A program that starts gis-radar as a worker sets `GIS_RADAR_LEASH=stdin` and keeps the worker's
standard input open. Closing it, on purpose or by dying, interrupts the worker as Ctrl+C would;
unlike a signal this works on every system and needs nobody alive to send it.
"""

from __future__ import annotations

import _thread
import os
import signal
import threading

VARIABLE = "GIS_RADAR_LEASH"


def wear_leash() -> None:
    """Watch standard input from now on, if the environment asks for it."""
    if os.environ.get(VARIABLE) == "stdin":
        # A worker started in the background would ignore the interruption.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        threading.Thread(target=_watch, args=(0,), daemon=True, name="leash").start()


def _watch(descriptor: int) -> None:
    """Wait for the end of the input; a reader of :mod:`io` would hold a lock at exit."""
    try:
        while os.read(descriptor, 1024):
            pass
    except OSError:
        pass  # nothing to read from is the end, too
    _interrupt()


def _interrupt() -> None:
    """Interrupt the main thread, out of a system call too where signals can do that."""
    if hasattr(signal, "pthread_kill"):
        main = threading.main_thread().ident
        if main is not None:
            signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()
