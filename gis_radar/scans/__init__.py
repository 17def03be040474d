"""The road from the air: airborne laser scans, masked by a map, as points of the road.

Loaded when it is first used, like the package's own front: who reads a road makes no mask.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
