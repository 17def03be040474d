from .root import City, open_city

__all__ = ["City", "open_city"]
