"""A site as one file, and the whole way from its raw data to its heat maps.

Nothing is imported here: a worker of a run starts with what it needs.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
