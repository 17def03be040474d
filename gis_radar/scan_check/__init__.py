"""Compare what stands around a sensor with an airborne scan: a check against the scan of a pose."""

from gis_radar.scan_check.check import ScanCheck, check_against_scan, require_scans_near
from gis_radar.scan_check.settings import ScanCheckSettings

__all__ = ["ScanCheck", "ScanCheckSettings", "check_against_scan", "require_scans_near"]
