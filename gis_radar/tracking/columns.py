"""Columns of the arrays that compiled code of the forward filter works on."""

from __future__ import annotations

NONE = -1

# Columns of a body; where lanes fork, each of its branches has a row.
X, Y, HEADING, SPEED, FRONT, REAR = range(6)
VAR_S, COV_SV, VAR_V, VAR_D, LAST, TIME, NUMBER, HITS = range(6, 14)
FOLLOWED, BRANCH, MISFIT, SINCE_M, COLUMNS = range(14, 19)  # SINCE_M: way since it forked
# Columns of a waiting detection: place, speed along a lane, the lane's heading, time, row.
WAIT_SPEED, WAIT_HEADING, WAIT_TIME, WAIT_ROW, WAIT_COLUMNS = range(2, 7)
# Columns of the lanes that lanes_at finds.
LANE, ALONG_LANE, LEFT, TOWARDS, HALF = range(5)
# Entries of counts: bodies alive, waiting detections; vehicles, detections and branches so far,
# branches before the present detections; states kept.
ALIVE, WAITS, BEGUN, PASSED, BRANCHES, BASE, KEPT, COUNTS = range(8)
