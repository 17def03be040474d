"""Clocks: how far those of several sensors are apart, by the vehicles that both see."""
