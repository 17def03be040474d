"""What lies in the folder of a dataset: its tables, their parts by hour, manifest and registry."""

STATED_LANES = "lanes.json"
"""Names and free speeds of lanes as their site states them; here, as a run needs the name alone."""
