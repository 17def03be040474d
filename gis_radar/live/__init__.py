"""Live: sensors that send detections over a network, the map of now, and the dataset of hours.

The way of a frame:

- at a sensor, `edge` reads it (`wire.sources`), with the pose that it follows, selects what lies
  near the road (`wire.detections`) and packs it (`wire.payload`); `wire.outbox` keeps it until
  the centre has stored it; `wire.broker` sends it;
- at the centre, which `fusion` runs, `intake` checks it and hands it to the map of `now`, to the
  vehicles of `now`, and to the spool on the disk (`hours.spool`);
- `hours` writes the spool into recordings and makes quarters and hours of the dataset of them;
- `served` shows both to others.

What the room offers is listed in `__init__.pyi` and loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
