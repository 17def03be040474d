"""Comparison of two periods: what changed by lane, how sure, and what cannot be told."""
