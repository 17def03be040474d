"""Sight: which tiles a sensor sees from one pose, and what hides the others."""
