"""Heat maps: occupancy of every tile, and its hit share.

What is offered is listed in `__init__.pyi` and loaded when it is first used: the live system sums
by lane and draws nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
