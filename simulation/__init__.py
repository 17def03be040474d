"""Simulated sites: road networks, traffic, radar recordings and airborne scans with known truth.

`simulation.presets` has models of radars and drivers by name: `textbook` with independent errors,
and as recorded, with uneven cycles, lasting targets, slowly changing errors, and drivers off the
middle of their lanes. `simulation.people` adds walkers and cyclists. `simulation.city` makes the
sites of a city, `simulation.drawn_days` months of them, drawn from measured minutes.
"""
