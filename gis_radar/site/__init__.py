"""A site as one file, and the whole way from its raw data to its heat maps.

Nothing is imported here: a worker of a run starts with what it needs.
"""
