"""Vehicles of the live system: followed by what sensors send, in a process beside fusion."""
