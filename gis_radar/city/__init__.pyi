from .health import fleet_health
from .month_page import MONTH_PAGE, write_month_page
from .root import City, open_city

__all__ = [
    "MONTH_PAGE",
    "City",
    "fleet_health",
    "open_city",
    "write_month_page",
]
