"""Where compiled kernels are kept: a folder for each state of their sources."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from relpos.fusion import kernel_cache


@pytest.fixture
def fusion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with one room: a kernel that uses a model's constant, and an estimator."""
    sources = {
        "compiled.py": "",
        "models/range.py": "SIGMA_M = 0.3\n",
        "models/unused.py": "A = 1\n",
        "room/kernels.py": "from relpos.fusion.compiled import compiled\n"
        "from relpos.fusion.models import (\n    range,\n)\n",
        "room/estimator.py": "from relpos.fusion.room import kernels\n",
    }
    for name, text in sources.items():
        file = tmp_path / "fusion" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    monkeypatch.setattr(kernel_cache, "FUSION", tmp_path / "fusion")
    return tmp_path / "fusion"


def folder_after(fusion: Path, name: str, text: str) -> tuple[Path, Path]:
    """The room's folder before and after a change of a file."""
    before = kernel_cache.folder(fusion / "room", fusion)
    (fusion / name).write_text(text)
    kernel_cache._imported.cache_clear()
    return before, kernel_cache.folder(fusion / "room", fusion)


def test_a_constant_that_a_kernel_imports_names_another_folder(fusion: Path) -> None:
    before, after = folder_after(fusion, "models/range.py", "SIGMA_M = 0.4\n")
    assert before != after


@pytest.mark.parametrize("name", ["room/estimator.py", "models/unused.py"])
def test_a_file_that_no_kernel_imports_changes_nothing(fusion: Path, name: str) -> None:
    before, after = folder_after(fusion, name, "B = 2\n")
    assert before == after


def test_every_import_of_a_kernel_s_file_is_found() -> None:
    sources = kernel_cache._sources(kernel_cache.FUSION / "bank")
    names = {source.relative_to(kernel_cache.FUSION).as_posix() for source in sources}
    assert {"compiled.py", "bank/lanes.py", "models/motion_variances.py", "vectormath.py"} <= names
    assert "bank/estimator.py" not in names


def test_without_a_writable_cache_a_session_and_its_processes_share_a_temporary_one(
    fusion: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "refused", [])
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "kernels"))
    folder = kernel_cache.folder_here(fusion / "room")
    assert folder.is_dir()
    assert folder.parent == Path(os.environ["NUMBA_CACHE_DIR"])
    kernel_cache.mark_complete("room")
    assert kernel_cache.is_complete(["room"])


@pytest.mark.parametrize("compiled", [False, True])
def test_a_full_disk_is_asked_for_no_new_kernels_and_keeps_those_it_has(
    tmp_path: Path, compiled: bool
) -> None:
    for room in ("bank", "models"):
        folder = kernel_cache.folder(kernel_cache.FUSION / room, tmp_path)
        folder.mkdir()
        if compiled:
            (folder / "kernel.nbc").touch()
    program = (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "from relpos.fusion import kernel_cache\n"
        "print(kernel_cache.folder_here(kernel_cache.FUSION / 'bank'))\n"
    )
    used = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert Path(used).is_relative_to(tmp_path) == compiled
