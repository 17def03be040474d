"""Make the hours of a dataset, again when its recordings change, and delete what is old."""
