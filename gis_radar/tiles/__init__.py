"""Tiles: slices of lanelets, half a metre along the lane and as wide as it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
