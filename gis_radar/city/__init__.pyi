from .city import City, open_city
from .health import fleet_health
from .month_page import write_month_page
from .run import CityRun, run_city
from .settings import city_template, is_city_file

__all__ = [
    "City",
    "CityRun",
    "city_template",
    "fleet_health",
    "is_city_file",
    "open_city",
    "run_city",
    "write_month_page",
]
