"""Configuration of Sphinx: `make docs` builds a site that loads nothing from other hosts."""

import gc
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "host"))

from relpos import __version__  # noqa: E402

# Nearly all of the pages' nodes stay: searched seldom for garbage, they cost a fifth less time.
gc.set_threshold(50_000)

project = "relpos"
release = version = __version__
author = "relpos contributors"
copyright = "relpos contributors, MIT licence"  # noqa: A001

extensions = ["myst_parser", "sphinx.ext.autodoc"]
highlight_language = "text"
language = "en"

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

autodoc_default_options = {"member-order": "bysource"}
autodoc_typehints = "signature"
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = f"relpos {version}"
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
html_static_path = ["print"]
html_css_files = ["print.css"]


def _commands(_: Any, document: str, source: list[str]) -> None:
    """Insert the help text of every command into the page of commands."""
    if document == "commands":
        help_text = subprocess.run(
            [sys.executable, "-m", "typer", "relpos.cli.main", "utils", "docs", "--name", "relpos"],
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        _, _, body = help_text.partition("\n## ")
        source[0] = source[0].replace("<!-- commands -->", "## " + body)


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _commands)
