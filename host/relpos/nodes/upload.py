"""Building the firmware and writing it into a board, by PlatformIO as anybody would."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

from relpos.errors import DeviceError
from relpos.nodes.boards import SWITCH, Board

ROOT = Path(__file__).resolve().parents[3]
UPLOAD_WITHIN_S = 600.0
"""Online, PlatformIO fetches its compiler the first time."""
_SILENT = ("not in sync", "not responding", "timeout", "getsync", "no response")


def platformio(root: Path = ROOT) -> list[str]:
    """The command to run: ``tools/pio`` where the system's AVR tools are, else PlatformIO itself.

    DeviceError in one line where there is neither, or no firmware to build.
    """
    if not (root / "platformio.ini").is_file():
        raise DeviceError("the firmware's sources are not here: run relpos from its repository")
    offline = (root / ".venv" / "bin" / "platformio").exists()
    if offline and shutil.which("avr-gcc") and shutil.which("avrdude"):
        return [str(root / "tools" / "pio")]
    for name in ("pio", "platformio"):
        if (found := shutil.which(name)) is not None:
            return [found]
    raise DeviceError("PlatformIO is missing: `make firmware` sets it up, or see platformio.org")


def upload(board: Board, port: str, root: Path = ROOT) -> int | None:
    """Build, write and verify; DeviceError says why not.

    Returns the bytes that were verified, or None where the uploader has not told them.
    """
    command = [*platformio(root), "run", "-e", board.environment, "-t", "upload"]
    try:
        done = subprocess.run(
            [*command, "--upload-port", port],
            cwd=root,
            capture_output=True,
            text=True,
            timeout=UPLOAD_WITHIN_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise DeviceError(f"{port}: the upload took over {UPLOAD_WITHIN_S:g} s") from error
    told = done.stdout + done.stderr
    if done.returncode != 0:
        raise DeviceError(f"{port}: {why(told)}")
    verified = re.search(r"(\d+) bytes of flash verified", told)
    return int(verified[1]) if verified else None


def why(told: str) -> str:
    """What went wrong in an upload, in one line, from what PlatformIO and avrdude have told."""
    low = told.lower()
    if "error:" in low and "avrdude" not in low:
        line = next(line for line in told.splitlines() if "error:" in line.lower())
        return f"the firmware does not build: {line.strip()}"
    if "can't open device" in low or "busy" in low:
        return "the port cannot be opened: does another program hold it?"
    if any(words in low for words in _SILENT):
        return f"the board does not answer: {SWITCH}"
    if "verification error" in low or "mismatch" in low:
        return "the program does not read back as it was written: is the cable good? Try again"
    lines = [line for line in told.splitlines() if line.strip()]
    return f"the upload failed: {lines[-1].strip() if lines else 'PlatformIO gave no reason'}"
