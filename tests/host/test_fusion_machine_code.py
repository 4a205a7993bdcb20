"""Who compiles kernels, and what that does to estimates."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from relpos.fusion import machine_code
from relpos.fusion.kernel_types import TYPES

FUSE = """
import hashlib
from relpos import fusion
from relpos.simulation.paper import simulate_paper
fusion.warm_up("bank")
run = simulate_paper("paper-p1", 1, {"seconds": 60.0})
estimator = fusion.make("bank", run.priors, {}, 0)
estimates = [e for m in run.measurements for e in estimator.process(m)] + estimator.finish()
print(hashlib.sha256(repr(estimates).encode()).hexdigest())
"""

CALLED = """
import json, sys
from relpos import fusion
from relpos.fusion import compiling
from relpos.simulation.paper import simulate_paper
for name in fusion.SETTINGS:
    fusion.warm_up(name)
    run = simulate_paper("paper-p1", 1, {"seconds": 20.0})
    estimator = fusion.make(name, run.priors, {}, 0)
    for measurement in run.measurements:
        estimator.process(measurement)
found = {}
for module in [m for name, m in sys.modules.items() if name.startswith("relpos.fusion.")]:
    for name, kernel in vars(module).items():
        stats = getattr(kernel, "stats", None)
        if stats is not None and kernel.py_func.__module__ == module.__name__:
            types = {*stats.cache_hits, *stats.cache_misses}
            found[f"{module.__name__.split('.')[-1]}.{name}"] = [str(t) for t in types]
listed = {name: str(compiling.types_of(name)) for name in compiling.TYPES}
print(json.dumps([found, listed]))
"""


def python(program: str, folder: Path | None = None) -> str:
    kept = {} if folder is None else {"NUMBA_CACHE_DIR": str(folder)}
    return subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | kept, capture_output=True, check=True, text=True,
    ).stdout  # fmt: skip


def test_kernels_are_kept_once_each_was_compiled_since_it_was_changed(tmp_path: Path) -> None:
    version = "".join(map(str, sys.version_info[:2]))
    for module in machine_code.KERNELS:
        assert not machine_code.is_kept([tmp_path])
        (tmp_path / f"{module}.f-1.py{version}.nbi").touch()
    assert machine_code.is_kept([tmp_path])
    os.utime(tmp_path / f"joint.f-1.py{version}.nbi", (0.0, 0.0))
    assert not machine_code.is_kept([tmp_path])


def test_what_another_modules_change_has_made_stale_is_compiled_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources, kept = tmp_path / "sources", tmp_path / "kept"
    kept.mkdir()
    shutil.copytree(machine_code.SOURCES, sources, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(machine_code, "SOURCES", sources)
    version = "".join(map(str, sys.version_info[:2]))
    files = [kept / f"{module}.f-1.py{version}.nbi" for module in machine_code.KERNELS]
    for file in files:
        file.touch()
    other = kept / f"smoother_kernels.f-1.py{version}.nbi"
    other.touch()
    later_s = time.time() + 10.0
    # No kernel stands there, but a kernel's figures do.
    assert "estimator" not in machine_code.KERNELS
    os.utime(sources / "estimator.py", (later_s, later_s))
    assert not machine_code.is_kept([kept])
    machine_code.forget([kept])
    assert [file.exists() for file in (*files, other)] == [*(False for _ in files), True]


def test_sessions_call_the_kernels_that_are_compiled_side_by_side_and_for_those_types() -> None:
    found, listed = json.loads(python(CALLED))
    called = {name: types for name, types in found.items() if types}
    assert "bank_kernels.take_ranges" in called
    others = {name: types for name, types in called.items() if types != [listed.get(name)]}
    assert not others, "not as in fusion/kernel_types.py, or for several types"
    assert set(TYPES) <= set(found) | set(machine_code.LATER["bank"]), "no kernels"


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """What would have been compiled."""
    told: list[tuple[str, ...]] = []

    def note(*lists: Sequence[str]) -> None:
        told.append(tuple(job for jobs in lists for job in jobs))

    monkeypatch.setattr(machine_code, "_compile", note)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(machine_code, "is_kept", lambda places, modules: False)
    return told


def test_an_estimator_waits_for_its_own_kernels_alone(jobs: list[tuple[str, ...]]) -> None:
    machine_code.compile_apart(("particle",))
    assert all("particle" in job for job in jobs[0])
    machine_code.compile_apart(("bank",))
    assert not any("particle" in job for job in jobs[1])


def test_where_nothing_can_be_written_one_start_compiles_once_and_leaves_nothing(
    jobs: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    left: list[Path] = []
    (tmp_path / "file").touch()
    monkeypatch.setattr(machine_code, "folders", lambda told: [tmp_path / "file" / "below"])
    monkeypatch.setattr("atexit.register", lambda do, folder, **_: left.append(Path(folder)))
    machine_code.compile_apart(("bank",))
    assert [Path(os.environ["NUMBA_CACHE_DIR"])] == left
    assert not any(job in machine_code.LATER["bank"] for job in jobs[0])
    left[0].rmdir()


def test_processes_that_die_leave_the_kernels_to_the_session(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "relpos.py").write_text("raise SystemExit(1)")
    machine_code.compile_apart(("bank",))
    assert not machine_code.is_kept([tmp_path])


@pytest.mark.soak
def test_the_first_start_after_an_installation_gives_the_estimates_of_every_later_one(
    tmp_path: Path,
) -> None:
    first, second = (python(FUSE, tmp_path) for _ in range(2))
    assert first == second
