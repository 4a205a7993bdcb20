"""Hatchling's hook: the firmware goes into the wheel, where relpos/paths.py looks for it.

Emulated nodes run it, and ``relpos node flash`` builds it, also where there is no repository.
"""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class FirmwareHook(BuildHookInterface):
    """Adds the firmware's PlatformIO project."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling; an editable installation finds the repository's own."""
        if version == "standard":
            for name in ("platformio.ini", "firmware"):
                build_data["force_include"][name] = f"relpos/firmware_project/{name}"
