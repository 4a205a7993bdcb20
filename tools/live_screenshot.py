"""Photograph the live page behind an emulated team: docs/images/live.png.

    .venv/bin/python tools/live_screenshot.py [--seconds 95] [--out docs/images/live.png]

Six boards run the production firmware in real time; `relpos demo --view` fuses and serves them;
the system's Chromium shows the page, without a window. The wearers get names, as their phones would
give them. The picture has 256 colours, for its size.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

NAMES = ("Anna", "Ben", "Chloé", "Dmitri", "Emil", "Fatima")
MOST_BYTES = 200_000
NAME_ALL = """async (names) => {
    for (const [k, name] of names.entries()) {
        await fetch("/api/name", { method: "POST", body: JSON.stringify({ node: k + 1, name }) });
    }
}"""


def main() -> None:
    """Start, wait, photograph."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=95.0, help="how long they walk before")
    parser.add_argument("--out", type=Path, default=Path("docs/images/live.png"))
    parser.add_argument("--dark", action="store_true")
    wanted = parser.parse_args()
    names = ("chromium-headless-shell", "chromium", "google-chrome")
    browser = next((path for name in names if (path := shutil.which(name))), None)
    if browser is None:
        raise SystemExit("no Chromium is installed: `apt-get install chromium`")
    with tempfile.TemporaryDirectory() as directory:
        command = [
            Path(sys.executable).with_name("relpos"), "demo", "--view", "--no-open",
            "--view-listen", "127.0.0.1:0", "--seconds", f"{wanted.seconds + 60:.0f}",
            "--out", Path(directory) / "live",
        ]  # fmt: skip
        session = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        try:
            photograph(browser, address_of(session), wanted.seconds, wanted.out, wanted.dark)
        finally:
            session.send_signal(signal.SIGINT)
            session.communicate()
    size = wanted.out.stat().st_size
    print(f"{wanted.out}: {size / 1000:.0f} kB")
    if size > MOST_BYTES:
        raise SystemExit(f"larger than {MOST_BYTES / 1000:.0f} kB")


def address_of(session: subprocess.Popen[str]) -> str:
    """Address of the page, as the command prints it."""
    assert session.stdout is not None
    for line in session.stdout:
        if found := re.search(r"http\S+token=\S+", line):
            return found.group(0)
    raise SystemExit("relpos demo --view printed no address")


def photograph(browser: str, address: str, after_s: float, out: Path, dark: bool) -> None:
    """Open the page, let them walk, keep what is seen."""
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=arguments)
        page = chromium.new_page(
            viewport={"width": 1280, "height": 760}, color_scheme="dark" if dark else "light"
        )
        page.goto(address)
        page.locator("#people li").nth(len(NAMES) - 1).wait_for(timeout=60_000)
        page.evaluate(NAME_ALL, list(NAMES))
        page.wait_for_timeout(1000.0 * after_s)
        photo = page.screenshot()
        chromium.close()
    image = Image.open(io.BytesIO(photo)).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    out.parent.mkdir(parents=True, exist_ok=True)
    image.save(out, optimize=True)


if __name__ == "__main__":
    main()
