"""Calibration: where sensors stand and look, how far their clocks are apart, and what confirms it.

From the data to the answers (*in* names the module that calls the others):

- `registration` compares traffic with lanes: `traces` links detections to tracks, `lanes` samples
  lanes, `matches` and `lane_paths` find the lane of each detection, `model` and `residuals`
  compare, `solver` fits, `hypotheses` searches, `adaptation` fits the model to the radar,
  `certainty` gives covariances and compares fits;
- `timing` compares clocks: `lane_detections` and `clock_offsets` of two sensors, in `clocks`;
- `scan` compares what stands around a sensor with a scan: `surroundings`, in `scan_check`;
- `single` finds the pose of one sensor: `moving` reads its traffic, `lane_method` and `icp` (the
  paper's) find poses, in `localization`;
- `several` adjusts the poses of several sensors: `correspondences` pairs their vehicles, `placing`
  chooses among poses, `adjustment` adjusts them, `network` decides, in `joint`;
- `monitoring` follows a pose: `windows` registers a window, `kalman_filter` takes it in, `moves`
  notices large and `stationary_targets` small moves, in `monitor`;
- `check` finds whether recordings, poses and map fit together: `excerpt` reads traffic and finds
  `faults`, `evidence` scores it on the lanes, `mistakes` lists what may be wrong, `explanations`
  chooses among them, `nearly_right` (by `fitted_pose`) measures what is left, `scene_change` and
  `odd_clocks` compare times and sensors, in `plausibility`.

`findings`, `unit_mistakes` and `range_scale` serve `single` and `check`.

What the room offers is listed in `__init__.pyi` and loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
