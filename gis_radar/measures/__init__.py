"""What is measured on tiles: which were hit in which 50 ms steps, and which could have been."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
