"""Heat maps: occupancy of every tile, and its hit share."""
