"""A pose over time: one window after the other, and whether the sensor has moved."""
