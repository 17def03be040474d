"""Vehicles: their tracks, and which tiles they cover in which steps.

What the room offers is listed in `__init__.pyi` and loaded when it is first used: who reads a
folder does not wait for what finds vehicles.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
