"""Optional libraries: which of an extra's are missing, and the line that installs them."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from collections.abc import Sequence
from functools import cache
from importlib import metadata

from relpos import paths
from relpos.errors import RelposError

PURPOSES = {
    "view": "the live page (`relpos fuse PORT --view`)",
    "recording": "recordings as MCAP and Foxglove (`--record`, `--foxglove`)",
    "report": "pictures and reports (`relpos report`, `relpos figures`)",
    "exchange": "maps, GPX and Cursor-on-Target (`relpos convert`, `--cot`)",
    "ros": "ROS 2 bags (`relpos convert --to rosbag2`)",
    "recordings": "public recordings in MATLAB and Excel files (`relpos recordings get`)",
}
"""Purpose of each extra for users; the others are for developers of relpos."""


@cache
def requirements(extra: str) -> tuple[str, ...]:
    """Return the requirements of an extra, in pip's notation (``starlette>=0.40``)."""
    root = paths.repository()
    if root is not None:
        # What an editable installation remembers is as old as that installation.
        project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        return tuple(project["optional-dependencies"].get(extra, ()))
    try:
        named = metadata.requires("relpos") or []
    except metadata.PackageNotFoundError:
        return ()
    found = []
    for line in named:
        requirement, _, marker = line.partition(";")
        if re.search(rf"""extra\s*==\s*['"]{re.escape(extra)}['"]""", marker):
            found.append(requirement.strip())
    return tuple(found)


def missing(extra: str) -> list[str]:
    """The requirements of the extra that are not installed."""
    return [line for line in requirements(extra) if not _installed(line)]


def _installed(requirement: str) -> bool:
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    try:
        metadata.distribution(name[0] if name else requirement)
    except metadata.PackageNotFoundError:
        return False
    return True


def install_line(needed: Sequence[str]) -> str:
    """The command that puts packages beside this very relpos, however it was installed."""
    packages = shlex.join(needed)
    prefix = sys.prefix.replace("\\", "/")
    if "/pipx/venvs/" in prefix:
        return f"pipx inject relpos {packages}"
    if "/uv/tools/" in prefix:
        return f"uv pip install --python {shlex.quote(sys.prefix)} {packages}"
    return f"{shlex.quote(sys.executable)} -m pip install {packages}"


def require(extra: str) -> None:
    """Raise RelposError where a package of the extra is not installed: the line that helps."""
    lacking = missing(extra)
    if lacking:
        raise missing_extra(lacking[0], extra)


def missing_extra(package: str, extra: str) -> RelposError:
    """The error to raise where ``package`` of ``extra`` cannot be imported: the line that helps.

    There is no relpos on PyPI that `pip install relpos[view]` could mean: packages are named.
    """
    needed = missing(extra) or list(requirements(extra)) or [package]
    return RelposError(f"{package} (extra '{extra}') is not installed: {install_line(needed)}")
