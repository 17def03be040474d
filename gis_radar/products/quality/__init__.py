"""Data quality of a dataset, by sensor and hour."""
