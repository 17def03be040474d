from .find import find_vehicles
from .folder import Vehicles, read_vehicles
from .merging import merge_vehicles

__all__ = ["Vehicles", "find_vehicles", "merge_vehicles", "read_vehicles"]
