"""Building the firmware and writing it into a board, by PlatformIO as anybody would."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from relpos import paths
from relpos.errors import DeviceError
from relpos.nodes.boards import SWITCH, Board

IMU = ("mpu9150", "mpu9250")
"""Sensors that the firmware can be built for; the first by itself."""
UPLOAD_WITHIN_S = 600.0
"""Online, PlatformIO fetches its compiler the first time."""
_SILENT = ("not in sync", "not responding", "timeout", "getsync", "no response")


def platformio(root: Path, which: Callable[[str], str | None] = shutil.which) -> list[str]:
    """The command to run: ``tools/pio`` where the system's AVR tools are, else PlatformIO itself.

    ``root`` is the firmware's project. DeviceError in one line where there is neither.
    """
    offline = (root / ".venv" / "bin" / "platformio").exists()
    if offline and which("avr-gcc") and which("avrdude"):
        return [str(root / "tools" / "pio")]
    for name in ("pio", "platformio"):
        if (found := which(name)) is not None:
            return [found]
    raise DeviceError(
        "PlatformIO is missing: `pipx install platformio` brings it (in the repository "
        "`make firmware` does)"
    )


def upload(board: Board, port: str, imu: str = IMU[0]) -> int | None:
    """Build, write and verify the firmware. DeviceError with the cause where that fails.

    ``imu`` is the sensor that it is built for, one of :data:`IMU`. Returns the bytes that were
    verified, or None where the uploader does not print them.
    """
    root = paths.firmware_project()
    command = [*platformio(root), "run", "-e", board.environment, "-t", "upload"]
    with subprocess.Popen(
        [*command, "--upload-port", port],
        cwd=root,
        env={**os.environ, **_environment(root, imu)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        try:
            printed = "".join(process.communicate(timeout=UPLOAD_WITHIN_S))
        except BaseException as error:
            _end(process)
            if isinstance(error, subprocess.TimeoutExpired):
                words = f"{port}: the upload took over {UPLOAD_WITHIN_S:g} s"
                raise DeviceError(words) from error
            raise
    if process.returncode != 0:
        raise DeviceError(f"{port}: {why(printed)}")
    verified = re.search(r"(\d+) bytes of flash verified", printed)
    return int(verified[1]) if verified else None


def _end(process: subprocess.Popen[str]) -> None:
    """End PlatformIO and its uploader, which would hold the port without it."""
    if os.name == "posix":
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()


def _environment(root: Path, imu: str) -> dict[str, str]:
    """Return what PlatformIO is to know: the sensor, and its build folder.

    That is in a repository its default, else in the user's cache.
    """
    environment = {}
    if imu != IMU[0]:
        flags = f"{os.environ.get('PLATFORMIO_BUILD_FLAGS', '')} -DRELPOS_IMU={imu.upper()}"
        environment["PLATFORMIO_BUILD_FLAGS"] = flags.strip()
    if root != paths.repository():
        environment["PLATFORMIO_WORKSPACE_DIR"] = str(paths.build_folder() / "platformio")
    return environment


def why(printed: str) -> str:
    """Return the cause of a failed upload in one line, from PlatformIO's and avrdude's output."""
    low = printed.lower()
    if "httpclienterror" in low or "internet connection" in low:
        return "PlatformIO cannot fetch its compiler: the first time it needs the Internet"
    if "error:" in low and "avrdude" not in low:
        line = next(line for line in printed.splitlines() if "error:" in line.lower())
        return f"the firmware does not build: {line.strip()}"
    if re.search("(can't open device|cannot open port) .*no such", low):
        return "the port has vanished: plug the board in and write the firmware again"
    if "can't open device" in low or "cannot open port" in low or "busy" in low:
        return "the port cannot be opened: does another program hold it?"
    if any(words in low for words in _SILENT):
        return f"the board does not answer: {SWITCH}"
    if "verification error" in low or "mismatch" in low:
        return "the program does not read back as it was written: is the cable good? Try again"
    lines = [line for line in printed.splitlines() if line.strip()]
    # The cause comes before the frames that make, SCons and avrdude put around it.
    lines = [line for line in lines if "error" in line.lower() and "***" not in line] or lines
    return f"the upload failed: {lines[-1].strip() if lines else 'PlatformIO gave no reason'}"
