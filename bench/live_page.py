"""How much of a computer the team's page takes: 20 people, 20 views a second.

    python bench/live_page.py [--people 20] [--seconds 10]

Prints, for views that do and do not move, the fraction of one core that the page's main thread is
busy, frames a second, and how late the drawing of a view ends after the server sent it (both on
this computer, one clock). Without a graphics card Chromium draws the canvas on the processor, in
another process; that is not in the first figure.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "view"))

from stage import NO_BROWSER, Stage, browser_of, chromium, sync_playwright
from walking_team import WalkingTeam

LISTEN = """document.addEventListener("relpos:drawn", (event) => {
    window.drawn.push([event.detail.seq, event.detail.unixMs]);
})"""
VIEWS = {"all": "#fit", "follow": "#follow", "turning": "#heading-up"}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--people", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=10.0)
    wanted = parser.parse_args()
    if chromium() is None:
        raise SystemExit(NO_BROWSER)
    stage = Stage(WalkingTeam(size=wanted.people))
    stage.rate_hz = 20.0
    try:
        with sync_playwright() as playwright, browser_of(playwright) as browser:
            page = browser.new_page(viewport={"width": 1920, "height": 1080})
            page.goto(stage.url())
            page.locator("#people li").first.wait_for()
            page.wait_for_timeout(3000)
            session = page.context.new_cdp_session(page)
            # Time of the thread, not of the wall: other programs shall not count.
            session.send("Performance.enable", {"timeDomain": "threadTicks"})
            page.evaluate(LISTEN)
            print(f"{wanted.people} people, 20 pictures a second, 1920 x 1080")
            for name, button in VIEWS.items():
                page.locator(button).click()
                page.wait_for_timeout(1500)
                page.evaluate("window.drawn = []")
                stage.sent.clear()
                before = metrics(session)
                page.wait_for_timeout(1000.0 * wanted.seconds)
                after = metrics(session)
                drawn = page.evaluate("window.drawn")
                busy = (after["TaskDuration"] - before["TaskDuration"]) / wanted.seconds
                late_ms = sorted(
                    at - 1000.0 * stage.sent[seq] for seq, at in drawn if seq in stage.sent
                )
                print(
                    f"  {name:8s} {100 * busy:5.1f} % of a core, "
                    f"{len(drawn) / wanted.seconds:5.1f} frames/s, "
                    f"drawn after {late_ms[len(late_ms) // 2]:.0f} ms (median), "
                    f"{late_ms[int(0.99 * len(late_ms))]:.0f} ms (99 %)"
                )
    finally:
        stage.close()


def metrics(session: Any) -> dict[str, float]:
    """The browser's own counters."""
    found = session.send("Performance.getMetrics")["metrics"]
    return {entry["name"]: float(entry["value"]) for entry in found}


if __name__ == "__main__":
    main()
