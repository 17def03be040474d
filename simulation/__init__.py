"""Simulated sites: road networks, traffic, radar recordings and airborne scans with known truth."""
