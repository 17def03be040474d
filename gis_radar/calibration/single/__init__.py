"""The pose of one sensor, from the registration of its traffic or by the method of the paper."""
