"""What lies in the folder of a dataset: its tables, their parts by hour, manifest and registry."""
