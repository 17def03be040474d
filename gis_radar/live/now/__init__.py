"""The map of now: which tiles are hit, and which vehicles drive where."""
