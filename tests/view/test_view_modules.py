"""The pages' modules: every test of ``modules/*.test.js``, in the browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from stage import Browser, Page

HERE = Path(__file__).parent / "modules"
STATIC = Path(__file__).parents[2] / "host" / "relpos" / "view" / "static"
TYPES = {
    ".js": "text/javascript",
    ".css": "text/css",
    ".html": "text/html",
    ".json": "application/json",
}
TESTS = [
    (path.name, sentence)
    for path in sorted(HERE.glob("*.test.js"))
    for sentence in re.findall(r'^test\("([^"]+)"', path.read_text("utf-8"), re.MULTILINE)
]


@pytest.fixture(scope="module")
def laboratory(browser: Browser) -> Iterator[Page]:
    """A page at an address of its own that has the modules, and nothing else."""
    context = browser.new_context()
    page = context.new_page()

    def serve(route: object) -> None:
        name = route.request.url.removeprefix("http://modules.test/")  # type: ignore[attr-defined]
        static = name.startswith("static/")
        path = STATIC / name.removeprefix("static/") if static else HERE / name
        if name == "":
            route.fulfill(body="<!doctype html><title>modules</title>", content_type="text/html")  # type: ignore[attr-defined]
        elif path.is_file():
            route.fulfill(body=path.read_text("utf-8"), content_type=TYPES[path.suffix])  # type: ignore[attr-defined]
        else:
            route.fulfill(status=404)  # type: ignore[attr-defined]

    page.route("http://modules.test/**", serve)
    page.goto("http://modules.test/")
    yield page
    context.close()


@pytest.mark.parametrize(("module", "sentence"), TESTS, ids=[s for _, s in TESTS])
def test_module(laboratory: Page, module: str, sentence: str) -> None:
    laboratory.evaluate(
        """async ([module, sentence]) => {
            await import(`http://modules.test/${module}`);
            const { run } = await import("http://modules.test/check.js");
            await run(sentence);
        }""",
        [module, sentence],
    )


def test_every_module_can_be_loaded_by_itself_and_asks_for_nothing_from_elsewhere() -> None:
    for path in [*STATIC.rglob("*.js"), *STATIC.rglob("*.css"), *STATIC.rglob("*.html")]:
        text = path.read_text("utf-8")
        addresses = re.findall(r"https?://[^\s\"'`)]+", text)
        assert [a for a in addresses if not a.startswith("http://www.w3.org/")] == [], path.name
        for name in re.findall(r'from "(\./[^"]+)"', text):
            assert (path.parent / name).is_file(), f"{path.name} imports {name}"
