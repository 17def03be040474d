"""Calibration: where sensors stand and look, how far their clocks are apart, and what confirms it.

- :mod:`~gis_radar.calibration.localization` finds the pose of one sensor from its traffic,
- :mod:`~gis_radar.calibration.joint` adjusts several by the vehicles that two of them see,
- :mod:`~gis_radar.calibration.scan_check` compares what stands around a sensor with a scan,
- :mod:`~gis_radar.calibration.monitor` follows a pose through a recording, and notices moves,
- :mod:`~gis_radar.calibration.clocks` compares the clocks of several sensors.

What the room offers is listed in `__init__.pyi` and loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
