"""Columns of the arrays that compiled code of the forward filter works on."""

from __future__ import annotations

NONE = -1

# Of a body: of several branches where lanes fork, a row each.
X, Y, HEADING, SPEED, FRONT, REAR = range(6)
VAR_S, COV_SV, VAR_V, VAR_D, LAST, TIME, NUMBER, HITS = range(6, 14)
FOLLOWED, BRANCH, MISFIT, SINCE_M, COLUMNS = range(14, 19)  # SINCE_M: way since it forked
# Of a waiting detection: place, speed along a lane, its heading, time, row.
WAIT_SPEED, WAIT_HEADING, WAIT_TIME, WAIT_ROW, WAIT_COLUMNS = range(2, 7)
# Of what lanes_at finds.
LANE, ALONG_LANE, LEFT, TOWARDS, HALF = range(5)
# Of counts: bodies alive, detections that wait; so far vehicles, detections, branches, those before
# the detections of now; states kept.
ALIVE, WAITS, BEGUN, PASSED, BRANCHES, BASE, KEPT, COUNTS = range(8)
