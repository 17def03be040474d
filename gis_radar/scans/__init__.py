"""The road from the air: airborne laser scans, masked by a map, as points of the road."""
