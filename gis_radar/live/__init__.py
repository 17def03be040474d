"""Live: sensors that send detections over a network, the map of now, and the hours' dataset."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
