"""Reports for people without QGIS: one HTML file, one PDF, and the tables as CSV."""
