"""Folders of hits, one an hour, as fusion stores them."""
