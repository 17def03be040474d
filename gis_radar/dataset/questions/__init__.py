"""Questions to a dataset: SQL, and profiles of streets over months."""
