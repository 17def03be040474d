"""Formats, one module for each: `recordings/formats.py` finds every module with a `FORMAT`."""
