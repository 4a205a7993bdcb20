"""The stand-in for PlatformIO's `native` platform."""

from platformio.platform.base import PlatformBase


class NativePlatform(PlatformBase):
    """Programs for this computer."""
