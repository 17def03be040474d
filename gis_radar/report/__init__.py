"""Reports for people without QGIS: one HTML file, one PDF, and the tables as CSV.

What is offered is listed in `__init__.pyi` and loaded when it is first used: a run of a site needs
the names of the files at once, the report itself last.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
