"""Live: sensors that send tiles over a network, and the map of now that is made of them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
