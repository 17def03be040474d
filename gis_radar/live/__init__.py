"""Live: sensors that send tiles over a network, and the map of now that is made of them."""
