"""Comparison of two periods: changes by lane with their significance."""
