"""Calibration: where sensors stand and look, how far their clocks are apart, and what confirms it.

- :mod:`~gis_radar.calibration.localization` finds the pose of one sensor from its traffic,
- :mod:`~gis_radar.calibration.joint` adjusts several by the vehicles that two of them see,
- :mod:`~gis_radar.calibration.scan_check` compares what stands around a sensor with a scan,
- :mod:`~gis_radar.calibration.monitor` follows a pose through a recording, and notices moves,
- :mod:`~gis_radar.calibration.clocks` compares the clocks of several sensors.

All but the scan check rest on one registration of traffic to lanes. From the data to the answers:

- traffic: `moving` and `excerpt` read detections, `traces` links them to tracks;
- lanes: `lanes` samples them, `matches` and `lane_paths` find the lane of each detection;
- registration: `model` and `residuals` compare, `solver` fits, `hypotheses` searches, `adaptation`
  fits the model to the radar, `certainty` gives covariances and compares fits;
- one sensor: `lane_method` and `icp` (the paper's) in `localization`;
- several sensors: `correspondences` pairs their vehicles, `placing` chooses among poses,
  `adjustment` adjusts them, `network` decides, in `joint`;
- over time: `windows` registers a window, `kalman_filter` takes it in, `moves`, `alarm` (by
  `lane_places`) and `stationary_targets` notice moves, `watch` asks the latter two, in `monitor`;
- clocks: `lane_detections` and `clock_offsets` compare two sensors, in `clocks`;
- check: `unit_mistakes` (by `range_scale`), `scene_change`, `explanations` (by `rivals`),
  `nearly_right` (by `fitted_pose` and `offsets`) and `odd_clocks`, in `plausibility`;
- scan check: `surroundings`, in `scan_check`.

What the room offers is listed in `__init__.pyi` and loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
