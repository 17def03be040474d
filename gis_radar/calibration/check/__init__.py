"""Check: whether recordings, poses and the map fit together, and what is wrong if not."""
