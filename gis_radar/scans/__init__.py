"""The road from the air: airborne laser scans, masked by a map, as points of the road."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
