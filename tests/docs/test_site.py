"""The documentation's site: it builds without a warning and loads nothing from other sites."""

import os
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 300


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built pages; a warning is an error."""
    pytest.importorskip("furo", reason="the extra 'docs' is not installed")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html",
         "-d", folder / "doctrees", "docs", folder / "html"],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT / "host")},
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "html"


class Requests(HTMLParser):
    """What a browser fetches for a page without being clicked."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if tag == "link" and given.get("rel") in ("canonical", "search", "index", "next", "prev"):
            return
        if tag in ("script", "link", "img", "iframe", "source", "video", "object"):
            named = (given.get("src"), given.get("href"), given.get("data"))
            self.addresses += [address for address in named if address]


def test_every_page_is_built(site):
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert pages <= {path.stem for path in site.glob("*.html")}
    assert len(pages) > 20


def test_the_built_pages_load_nothing_from_other_sites(site):
    for page in site.rglob("*.html"):
        requests = Requests()
        requests.feed(page.read_text(encoding="utf-8"))
        assert requests.addresses, page
        foreign = [a for a in requests.addresses if a.startswith(("http:", "https:", "//"))]
        assert not foreign, page
    for sheet in site.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        assert "url(http" not in text
        assert "url(//" not in text
        assert "@import url" not in text


def test_every_command_has_its_part_with_its_options(site):
    text = (site / "commands.html").read_text(encoding="utf-8")
    for name in ("relpos-doctor", "relpos-node-flash", "relpos-node-calibrate-antenna"):
        assert f'id="{name}"' in text, name
    assert "--key-file" in text


def test_docstrings_are_in_the_pages(site):
    text = (site / "modules.html").read_text(encoding="utf-8")
    assert 'id="relpos.measurements.Motion"' in text
    assert "counter-clockwise" in text
