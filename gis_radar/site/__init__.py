"""A site as one file, and the whole way from its raw data to its heat maps."""

from gis_radar.site.run import SiteRun, run_site
from gis_radar.site.site import Site, read_site
from gis_radar.site.template import site_template

__all__ = ["Site", "SiteRun", "read_site", "run_site", "site_template"]
