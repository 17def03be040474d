"""Single vehicles: their states at any step, and their footprints as a layer."""
