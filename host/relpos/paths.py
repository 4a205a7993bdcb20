"""Folders of the firmware's project and of built files, in a repository or installed.

A wheel brings the firmware's sources along (``relpos/firmware_project``), so that emulated nodes
and ``relpos node flash`` work without the repository; what is built from them goes into the user's
cache, because an installed package's folder may be read-only.
"""

from __future__ import annotations

from pathlib import Path

from relpos.errors import DeviceError

_REPOSITORY = Path(__file__).resolve().parents[2]
_INSTALLED = Path(__file__).resolve().parent / "firmware_project"


def repository() -> Path | None:
    """The repository that this package lies in, or None where it was installed."""
    return _REPOSITORY if (_REPOSITORY / "platformio.ini").is_file() else None


def firmware_project() -> Path:
    """The folder of platformio.ini and firmware/. DeviceError where a package lacks them."""
    for folder in (_REPOSITORY, _INSTALLED):
        if (folder / "platformio.ini").is_file() and (folder / "firmware" / "lib").is_dir():
            return folder
    raise DeviceError("the firmware's sources are not here: install relpos anew, from its wheel")


def build_folder() -> Path:
    """Folder for compiled things: .build in the repository, else one in the user's cache."""
    root = repository()
    if root is not None:
        return root / ".build"
    from platformdirs import user_cache_path

    return user_cache_path("relpos", appauthor=False)
