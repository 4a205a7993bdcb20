"""Fetches a public source, converts it and checks what came out."""

from __future__ import annotations

import http.client
import shutil
import tempfile
import urllib.request
from collections.abc import Sequence
from pathlib import Path

from relpos.errors import DataError, RelposError
from relpos.recordings.catalog import SOURCES, Source
from relpos.recordings.tables import Archive, ConvertedRun, digest

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
    written then, nor where the disk is full.
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
        except Exception as error:  # Of archives, tables, pickles: each has errors of its own.
            if isinstance(error, RelposError) or getattr(error, "filename", None):
                raise
            words = f"{type(error).__name__}: {error}"
            raise DataError(f"{name}: the source has changed ({words})") from None
    found = digest(runs)
    if source.sha256 and found != source.sha256:
        raise DataError(
            f"{name}: {len(runs)} runs, but not those that the figures rest on "
            f"(SHA-256 {found[:16]}, expected {source.sha256[:16]}): the source has changed"
        )
    names = [run.name for run in runs]
    if len(set(names)) < len(names) or any(Path(n).name != n or n == ".." for n in names):
        raise DataError(f"{name}: runs with one name, or with none: the source has changed")
    _write(runs, out)
    return len(runs)


def _write(runs: Sequence[ConvertedRun], out: Path) -> None:
    """Write all runs beside, and put them in their place together."""
    new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix=".part-", dir=out) as part:
            for run in runs:
                run.write(Path(part))
            for folder in Path(part).iterdir():
                folder.replace(out / folder.name)
    except OSError as error:
        raise DataError(f"{out}: {error.strerror}; nothing was written") from None
    finally:
        if new and not any(out.iterdir()):
            out.rmdir()


def _download(address: str, path: Path) -> None:
    try:
        with (
            urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer,
            path.open("wb") as file,
        ):
            shutil.copyfileobj(answer, file)
            # The library raises nothing where an announced length is not reached.
            if missing := answer.length:
                raise DataError(f"{address}: broke off {missing} bytes before its end; try again")
    except (OSError, http.client.HTTPException) as error:
        raise DataError(f"{address}: {getattr(error, 'reason', error)}") from None
