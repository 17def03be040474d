from .root import City, open_city, site_folder
from .run import CityRun, run_city
from .settings import CityFile, city_reference, city_template, is_city_file, read_city_file

__all__ = [
    "City",
    "CityFile",
    "CityRun",
    "city_reference",
    "city_template",
    "is_city_file",
    "open_city",
    "read_city_file",
    "run_city",
    "site_folder",
]
