"""Settings of the manual: `make docs` builds it into out/site, strictly, without running examples or the network."""

from __future__ import annotations

import sys
from pathlib import Path

_HERE = Path(__file__).parent
sys.path[:0] = [str(_HERE.parent), str(_HERE)]

from qsim.files import VERSION  # noqa: E402

project = "qsim and quiver"
author = copyright = "The qsim developers"  # noqa: A001
version = release = VERSION
html_title = "qsim and quiver"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "sphinx_design",
    "manual",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext", ".py": "markdown"}  # .py: the examples
exclude_patterns = ["examples/own_parts", "*.py", "manual/*", "results/*.json", "examples/results/*.json"]
suppress_warnings = ["ref.python"]  # some classes share a name, as Clip

myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
myst_links_external_new_tab = False

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_default_options = {"no-value": True}
python_maximum_signature_line_length = 80
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["manual.css"]
html_show_sourcelink = False
html_copy_source = False
html_show_search_summary = False  # summaries are fetched, which browsers refuse for pages from the disk
html_theme_options = {
    "logo": {"text": "qsim and quiver"},
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "navbar_end": ["theme-switcher"],
    "navbar_persistent": ["search-button"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
    "navigation_depth": 3,
    "collapse_navigation": True,
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
    "secondary_sidebar_items": ["page-toc"],
}
copybutton_exclude = ".linenos, .gp"
