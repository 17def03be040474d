from .health import fleet_health
from .month_page import write_month_page
from .root import City, open_city

__all__ = [
    "City",
    "fleet_health",
    "open_city",
    "write_month_page",
]
