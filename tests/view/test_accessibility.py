"""axe-core finds nothing serious on the pages, in both themes and with every dialog open."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from stage import Stage
from test_languages import troubled

axe_package = pytest.importorskip("axe_playwright_python")
AXE = (Path(axe_package.__file__).parent / "axe.min.js").read_text("utf-8")
SERIOUS = ("serious", "critical")
COLOURS = ["color-contrast", "link-in-text-block"]


def findings(page: Page) -> list[str]:
    """What axe-core calls serious or critical, in both themes: rule, and where."""
    found = []
    # The themes differ in nothing but colours.
    for theme, rules in (("light", {}), ("dark", {"runOnly": COLOURS})):
        page.emulate_media(color_scheme=theme)  # type: ignore[arg-type]
        expect(page.locator("html")).to_have_attribute("data-theme", theme)
        violations = page.evaluate(
            """(given) => axe.run(document, { resultTypes: ["violations"], ...given })
                .then((found) => found.violations)""",
            rules,
        )
        found += [
            f"{violation['id']}, {theme}: {node['target']} {node['failureSummary']}"
            for violation in violations
            if violation["impact"] in SERIOUS
            for node in violation["nodes"][:3]
        ]
    return found


def test_the_team_page_has_no_serious_finding(visit: Any, theatre: Stage) -> None:
    theatre.reset(troubled())
    page = visit(viewport={"width": 1366, "height": 768}, reduced_motion="reduce", expect_gone=True)
    page.evaluate(AXE)
    expect(page.locator("#alarms .alarm").first).to_be_visible()
    page.locator(".person .name").first.click()
    found = findings(page)
    for opener, dialog in (("show-log", "log"), ("help", "help"), ("phones", "phones")):
        page.locator(f"#{opener}").click()
        found += findings(page)
        page.locator(f"#{dialog}-dialog form button").last.click()
    page.locator("#show-board").click()
    expect(page.locator("#board-rows tr")).to_have_count(6)
    assert [*found, *findings(page)] == []
    # A button without a name would be found.
    page.locator("#help").evaluate("button => button.textContent = ''")
    assert any(finding.startswith("button-name") for finding in findings(page))


def test_the_phone_page_has_no_serious_finding(visit: Any, theatre: Stage) -> None:
    theatre.reset(troubled())
    page = visit("/phone", viewport={"width": 390, "height": 844}, reduced_motion="reduce")
    page.evaluate(AXE)
    page.locator("[data-wearer='2']").click()
    found = findings(page)
    page.locator("#name-form button").click()
    expect(page.locator("#press")).to_be_visible()
    found += findings(page)
    page.locator("nav button[data-page='team']").click()
    found += findings(page)
    page.locator(".other button").first.click()
    assert [*found, *findings(page)] == []
