"""Registration of traffic to lanes: tracks of moving vehicles, and the pose that fits them."""
