from .city import City as City
from .city import open_city as open_city
from .health import fleet_health as fleet_health
from .month_page import write_month_page as write_month_page
from .run import CityRun as CityRun
from .run import run_city as run_city
from .settings import city_template as city_template
from .settings import is_city_file as is_city_file
