"""Joint calibration: poses of several sensors, adjusted by vehicles that two of them see."""

from gis_radar.joint.calibration import JointCalibration, localize_together

__all__ = ["JointCalibration", "localize_together"]
