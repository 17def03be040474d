"""The formats, one module each; a module here that has a `FORMAT` is found by itself."""
