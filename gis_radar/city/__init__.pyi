from .health import fleet_health
from .month_page import MONTH_PAGE, write_month_page
from .root import City, open_city, site_folder
from .run import CityRun, run_city
from .settings import CityFile, city_reference, city_template, is_city_file, read_city_file

__all__ = [
    "MONTH_PAGE",
    "City",
    "CityFile",
    "CityRun",
    "city_reference",
    "city_template",
    "fleet_health",
    "is_city_file",
    "open_city",
    "read_city_file",
    "run_city",
    "site_folder",
    "write_month_page",
]
