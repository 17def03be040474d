"""Sheets for a report: a print layout, and an atlas over places and intervals."""
