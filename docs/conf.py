"""Settings of the documentation: built by `make docs`, without the network."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "gis_radar"
author = "The gis_radar authors"
project_copyright = author
version = release = version_of("gis_radar")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_click",
    "command_examples",
    "mathml",
    "public_names",
]
exclude_patterns = ["_ext"]
nitpicky = True
# Only our own names can be resolved without the network.
nitpick_ignore_regex = [("py:.*", r"(?!gis_radar\b).*")]
suppress_warnings = [
    "ref.python"
]  # types in docstrings are short names, which several modules have

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 600
# Else a notebook with widgets would load scripts from outside.
nb_ipywidgets_js: dict[str, dict[str, str]] = {}

autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
add_module_names = False
maximum_signature_line_length = 100
default_role = "literal"
smartquotes = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"gis_radar {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1d4f91", "color-brand-content": "#1d4f91"},
    "dark_css_variables": {"color-brand-primary": "#8ab4f8", "color-brand-content": "#8ab4f8"},
}
