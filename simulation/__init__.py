"""Simulated sites: road networks, traffic, radar recordings and airborne scans with known truth.

`simulation.presets` has radars and drivers by name: a textbook's, whose errors average out, and as
recorded, with staggered frames, targets that last, biases that wander and drivers off the middle of
their lanes. `simulation.people` adds walkers and cyclists, who are in the truth with their kind.
`simulation.city` makes sites beside each other, `simulation.drawn_days` months of which each
quarter of an hour sums measured parts.
"""
