"""The poses of several sensors, adjusted together by the vehicles that two of them see."""
