"""The stand-in for PlatformIO's `atmelavr` platform."""

from platformio.platform.base import PlatformBase


class AtmelavrPlatform(PlatformBase):
    """Boards that are built by the system's avr-gcc."""

    def is_embedded(self) -> bool:
        """Return True: there is no package of type uploader to tell it from."""
        return True
