"""The site that `make docs` makes of these pages: nothing is fetched, when it is built or read."""

import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent / "extension"))

project = "Multi-robot visual SLAM"
author = "The multi_robot_slam authors"
copyright = author
release = metadata.version("multi_robot_slam")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "mathml", "reference"]
exclude_patterns = ["extension"]

myst_enable_extensions = ["deflist", "dollarmath"]
# As GitHub makes anchors of headings: a link works in both places.
myst_heading_anchors = 3
highlight_language = "text"

# In docstrings `name` is code, as in Markdown.
default_role = "code"
autodoc_member_order = "bysource"
maximum_signature_line_length = 80

html_theme = "furo"
html_title = project
html_math_renderer = "mathml"
# With a font that has tall brackets and large sums, which few machines bring along. Found, not
# imported: ziamath changes what latex2mathml does.
FONT = Path(find_spec("ziamath").origin).parent / "fonts" / "STIXTwoMath-Regular.ttf"
html_static_path = ["extension/static", str(FONT)]
html_css_files = ["site.css"]
html_copy_source = False

TABLES = {"real": "Real robots, every set-up", "figures/statements": "The paper's statements"}
"""Pages that a study wrote, which begin without a title."""


def _with_title(_: Sphinx, page: str, text: list[str]) -> None:
    if page in TABLES:
        text[0] = f"# {TABLES[page]}\n\n" + text[0].replace("### ", "## ")


def setup(app: Sphinx) -> None:
    """What Sphinx calls."""
    app.connect("source-read", _with_title)
