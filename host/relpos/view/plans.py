"""Images of plans that lie under the map: in the mission's folder, else in memory."""

from __future__ import annotations

import contextlib
import hashlib
import re
from pathlib import Path

from relpos.files import write_whole
from relpos.said import Said

MAX_IMAGE_BYTES = 8 << 20
TYPES = {
    "png": ("image/png", b"\x89PNG\r\n\x1a\n"),
    "jpg": ("image/jpeg", b"\xff\xd8\xff"),
    "webp": ("image/webp", b"RIFF"),
}
"""What browsers show, by the first bytes; SVG is left out, because it can hold scripts."""


class PlanImages:
    """Images by the hash of their content, under ``folder``/plans."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = None if folder is None else folder / "plans"
        self._kept: dict[str, bytes] = {}

    def keep(self, data: bytes) -> str:
        """Keep an image, and return its name. ValueError where it is none, OSError."""
        kinds = [kind for kind, (_, head) in TYPES.items() if data.startswith(head)]
        if not kinds:
            raise ValueError(Said("image-kind", "neither PNG nor JPEG nor WebP"))
        name = f"{hashlib.sha256(data).hexdigest()[:16]}.{kinds[0]}"
        if self._folder is None:
            self._kept = {name: data}
            return name
        self._folder.mkdir(exist_ok=True)
        write_whole(self._folder / name, data, sync=True)
        return name

    def find(self, name: str) -> tuple[bytes, str] | None:
        """Return an image and its type; None where there is none of that name."""
        found = re.fullmatch(r"[0-9a-f]{16}\.(png|jpg|webp)", name)
        if found is None:
            return None
        data = self._kept.get(name)
        if data is None and self._folder is not None:
            with contextlib.suppress(OSError):
                data = (self._folder / name).read_bytes()
        kind, head = TYPES[found[1]]
        return None if data is None or not data.startswith(head) else (data, kind)
