"""Scan check: what stands around a sensor, compared with an airborne scan."""
