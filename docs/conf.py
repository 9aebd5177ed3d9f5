"""The documentation as a site: `make docs` writes docs/_site, which works without a network."""

import re
from pathlib import Path

from soma_core import __version__

project = "SOMA Core"
author = "The SOMA Core authors"
copyright = author  # noqa: A001 - the name that Sphinx reads
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["_site", "_live"]
html_extra_path = ["_live/body.html"]  # what index.md shows; `make docs` writes it
html_theme = "furo"
html_title = f"SOMA Core {version}"
html_show_sourcelink = False
html_theme_options = {"top_of_page_buttons": []}

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

autodoc_member_order = "groupwise"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
add_module_names = False
napoleon_numpy_docstring = False
default_role = "code"

_HERE = Path(__file__).parent
_README = re.compile(r"\]\(\.\./(\w+(?:/\w+)*)/README\.md")


def _readmes(_app: object, _page: str, source: list[str]) -> None:
    """Make pages of the READMEs elsewhere in the repository that a page links to."""
    for folder in _README.findall(source[0]):
        text = (_HERE.parent / folder / "README.md").read_text(encoding="utf-8")
        text = re.sub(r"\]\((\.\./)+docs/", "](../", text)
        page = _HERE / "_readmes" / f"{folder.replace('/', '_')}.md"
        page.parent.mkdir(exist_ok=True)
        page.write_text(f"---\norphan: true\n---\n{text}", encoding="utf-8")
    source[0] = _README.sub(lambda found: f"](_readmes/{found[1].replace('/', '_')}.md", source[0])


def setup(app: object) -> None:
    """Called by Sphinx, before it looks for pages: those of the READMEs are made at once."""
    for page in _HERE.glob("*.md"):
        _readmes(app, page.stem, [page.read_text(encoding="utf-8")])
    app.connect("source-read", _readmes)  # type: ignore[attr-defined]
