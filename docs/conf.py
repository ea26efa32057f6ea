"""Settings of the documentation; `python docs/build.py` builds it."""

from pathlib import Path

import torch_pbd

project = "torch_pbd"
author = "The torch_pbd developers"
release = version = torch_pbd.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build"]
templates_path = ["templates"]
default_role = "autolink"  # names that are public become links, others stay as they are
nitpicky = True
smartquotes = False  # default="m" is code

autosummary_generate = True
autodoc_typehints = "none"  # the docstrings say more
toc_object_entries_show_parents = "hide"
numpydoc_show_class_members = False  # the template of classes shows them
myst_heading_anchors = 3
myst_url_schemes = ["http", "https"]

html_theme = "pydata_sphinx_theme"
html_title = "torch_pbd"
html_show_sourcelink = False
html_theme_options = {"show_prev_next": False, "navigation_with_keys": False, "header_links_before_dropdown": 6}
# Pages without pages below them have no list of those.
html_sidebars = {page.stem: [] for page in Path(__file__).parent.glob("*.md")}
html_static_path = ["static"]
html_css_files = ["tables.css"]
copybutton_prompt_text = ">>> "

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "download_all_examples": False,
    "write_computation_times": False,  # its page loads a script of another host
    "show_signature": False,
    "abort_on_example_error": True,
    "min_reported_time": 10.0,
    "image_scrapers": ("matplotlib",),
    "within_subsection_order": "FileNameSortKey",
}
