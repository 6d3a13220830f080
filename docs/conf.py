"""How Sphinx makes a site of these pages: `make docs`. A warning is an error, and nothing is fetched."""

project = "Flotilla"
author = "the Flotilla project"
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
nitpicky = True
highlight_language = "none"
html_theme = "alabaster"
html_theme_options = {
    "description": "Real-time Linux card images for robot fleets",
    "page_width": "1180px",
    "sidebar_width": "260px",
    "font_family": "sans-serif",
    "head_font_family": "sans-serif",
}
html_sidebars = {"**": ["about.html", "searchbox.html", "navigation.html"]}
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
