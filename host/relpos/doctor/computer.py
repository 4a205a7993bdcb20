"""The checks' questions to the operating system, in one place, so that tests can replace it."""

from __future__ import annotations

import getpass
import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

COMMAND_WITHIN_S = 10.0


@dataclass
class SerialPort:
    """A port as the system lists it; ids are None for a port that is not on USB."""

    device: str
    description: str
    vid: int | None
    pid: int | None


class Computer:
    """This computer."""

    platform = sys.platform

    def which(self, name: str) -> str | None:
        """Return the path of a command, or None."""
        return shutil.which(name)

    def output_of(self, *command: str) -> str:
        """Return what a command prints, "" where it is missing, fails or does not end."""
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=COMMAND_WITHIN_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired):
            return ""
        return done.stdout if done.returncode == 0 else ""

    def processes(self) -> dict[int, str]:
        """Return process ids and names; nothing where the system has no /proc."""
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # it may have ended meanwhile
                # The system cuts a name after 15 bytes, also amid a letter.
                found[int(folder.name)] = (folder / "comm").read_text(errors="replace").strip()
        return found

    def holders(self, device: str) -> list[str]:
        """Return the visible processes that have the device open, as `name (id)`."""
        try:
            wanted = os.path.realpath(device)
        except OSError:
            return []
        found = []
        for pid, name in self.processes().items():
            with suppress(OSError):
                for link in Path(f"/proc/{pid}/fd").iterdir():
                    if str(link.readlink()) == wanted:
                        found.append(f"{name} ({pid})")
                        break
        return found

    def ports(self) -> list[SerialPort]:
        """Return the serial ports that the system lists."""
        from serial.tools.list_ports import comports

        return [SerialPort(p.device, p.description or "", p.vid, p.pid) for p in comports()]

    def exists(self, device: str) -> bool:
        """Return whether a device exists."""
        return Path(device).exists()

    def may_use(self, device: str) -> bool:
        """Return whether this user may read and write a device."""
        return os.access(device, os.R_OK | os.W_OK)

    def group_of(self, device: str) -> str:
        """Return the group of a device; "" on systems without groups."""
        try:
            return Path(device).group()
        except (OSError, KeyError, NotImplementedError):
            return ""

    def has_group_after_login(self, group: str) -> bool:
        """Return whether the user is in a group from the next login on."""
        try:
            import grp

            return getpass.getuser() in grp.getgrnam(group).gr_mem
        except (ImportError, KeyError, OSError):
            return False

    def user(self) -> str:
        """Return the user's name."""
        try:
            return getpass.getuser()
        except (OSError, KeyError):
            return "$USER"

    def free_bytes(self, folder: Path) -> int:
        """Return the free bytes on the disk of ``folder``, which may not exist yet."""
        return shutil.disk_usage(_there(folder)).free

    def may_write(self, folder: Path) -> bool:
        """Return whether files can be written to the folder, which may not exist yet."""
        folder = _there(folder)
        return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)

    def now(self) -> datetime:
        """Return the time, in the computer's time zone."""
        return datetime.now().astimezone()

    def sleeps_on(self) -> bool:
        """Return whether there is a clock that counts on while the computer sleeps."""
        return hasattr(time, "CLOCK_BOOTTIME")

    def environment(self, name: str) -> str:
        """Return an environment variable, or ""."""
        return os.environ.get(name, "")


def _there(folder: Path) -> Path:
    """Return the folder, or the first above it that this user can see."""
    while folder != folder.parent:
        with suppress(PermissionError):
            if folder.exists():
                break
        folder = folder.parent
    return folder
