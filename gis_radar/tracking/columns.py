"""Columns of the arrays of the forward filter, whose code is compiled."""

from __future__ import annotations

NONE = -1

# Columns of a body: place, heading, speed, reach ahead and behind; variances of place and speed
# along the lane and their covariance, variance of the place across; times of the last detection and
# of the state; number of the vehicle, of its detections; lane followed, branch, sum of costs of
# association, distance since its last fork. Where lanes fork, each branch of a vehicle has a row.
X, Y, HEADING, SPEED, FRONT, REAR = range(6)
VAR_S, COV_SV, VAR_V, VAR_D, LAST_TIME, TIME, NUMBER, DETECTION_COUNT = range(6, 14)
FOLLOWED, BRANCH, MISFIT, SINCE_M, BODY_COLUMNS = range(14, 19)
# Columns of a stored detection: place (X, Y), speed along a lane, the lane's heading, time, row.
WAIT_SPEED, WAIT_HEADING, WAIT_TIME, WAIT_ROW, WAIT_COLUMNS = range(2, 7)
# Columns of the lanes that lanes_at finds: lane, place along and left of it, heading, half width.
LANE, ALONG_LANE, LEFT, TOWARDS, HALF = range(5)
# Entries of counts: bodies alive, stored detections; vehicles, detections and branches so far;
# branches before the present detections; logged states of branches.
ALIVE, WAITS, BEGUN, PASSED, BRANCHES, BASE, KEPT, COUNT_ENTRIES = range(8)
