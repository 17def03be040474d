"""Poses: where a sensor stands and looks, its files, and its layers on a map."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
