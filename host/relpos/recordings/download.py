"""Fetches a public source, converts it and checks what came out."""

from __future__ import annotations

import http.client
import shutil
import tempfile
import urllib.error
import urllib.request
import zipfile
from pathlib import Path

from relpos.errors import DataError
from relpos.recordings.catalog import SOURCES, Source
from relpos.recordings.tables import Archive, digest

TIMEOUT_S = 60.0


def source_of(name: str) -> Source:
    """The source of that name; DataError where there is none."""
    for source in SOURCES:
        if source.name == name:
            return source
    raise DataError(f"no recordings '{name}': `relpos recordings list` shows them")


def get(name: str, out: Path, mirror: Path | None = None) -> int:
    """Write the runs of a source below ``out`` and return how many; ``mirror`` is a copy of it.

    DataError where it cannot be fetched, or has changed since it was last looked at. Nothing is
    written then.
    """
    source = source_of(name)
    if out.exists() and any(out.iterdir()):
        raise DataError(f"{out}: not empty; choose another folder with --out")
    with tempfile.TemporaryDirectory(prefix="relpos-recordings-") as scratch:
        path = mirror
        if path is None:
            path = Path(scratch) / "source.zip"
            _download(source.address, path)
        elif not path.exists():
            raise DataError(f"{path}: no such file or folder")
        try:
            runs = list(source.convert(Archive(path)))
        except (zipfile.BadZipFile, ValueError, KeyError, IndexError) as error:
            raise DataError(f"{name}: the source has changed ({error})") from None
    found = digest(runs)
    if source.sha256 and found != source.sha256:
        raise DataError(
            f"{name}: {len(runs)} runs, but not those that the figures rest on "
            f"(SHA-256 {found[:16]}, expected {source.sha256[:16]}): the source has changed"
        )
    for run in runs:
        run.write(out)
    return len(runs)


def _download(address: str, path: Path) -> None:
    try:
        with (
            urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer,
            path.open("wb") as file,
        ):
            shutil.copyfileobj(answer, file)
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as error:
        raise DataError(f"{address}: {getattr(error, 'reason', error)}") from None
