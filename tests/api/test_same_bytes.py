"""One recording gives the same bytes by every way, with compiled kernels in the cache or not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import relpos
from relpos import fusion
from relpos.fusion import kernel_cache
from relpos.recording import save_recording

FIRST_CALLS = """
import relpos
from relpos import fusion

assert not fusion.is_compiled(ESTIMATOR)
run = relpos.load("walk")
relpos.fuse(run, ESTIMATOR, seed=4).save("first call")
relpos.fuse(run, ESTIMATOR, seed=4).save("second call")
"""

WITH_A_KEPT_CACHE = """
import relpos
from relpos import fusion
from relpos.cli.main import app

assert fusion.is_compiled(ESTIMATOR)
relpos.fuse(relpos.load("walk.mcap"), ESTIMATOR, seed=4).save("recording by the API")
for source in ("walk", "walk.mcap"):
    words = ["fuse", source, "--estimator", ESTIMATOR, "--seed", "4", "--no-report"]
    app([*words, "--out", f"{source} by the command"], standalone_mode=False)
"""


@pytest.mark.parametrize(
    ("estimator", "missing"),
    [
        ("bank", "variance_components.*"),
        pytest.param("bank", "*", marks=pytest.mark.soak),
        pytest.param("particle", "*", marks=pytest.mark.soak),
    ],
)
def test_command_and_api_give_the_same_bytes_with_and_without_compiled_kernels(
    tmp_path: Path, estimator: str, missing: str
) -> None:
    """``missing``: the kernels that are not in the cache at first."""
    run = relpos.simulate("paper-p1", 11, seconds=20, nodes=3)
    relpos.save(run, tmp_path / "walk")
    save_recording(tmp_path / "walk.mcap", run)
    cache = tmp_path / "cache"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    # Everybody's start is given: the kernels that seek it are not called, and need not be compiled.
    for room in {"initialisation", *fusion.ROOMS[estimator]}:
        kept = kernel_cache.folder_here(kernel_cache.FUSION / room)
        without = (missing, "complete") if room == estimator else ()
        shutil.copytree(kept, cache / kept.name, ignore=shutil.ignore_patterns(*without))
    for program in (FIRST_CALLS, WITH_A_KEPT_CACHE):
        code = f"ESTIMATOR = {estimator!r}\n{program}"
        subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
    estimates = {path.parent.name: path.read_bytes() for path in tmp_path.glob("*/estimate.csv")}
    assert len(estimates) == 5, sorted(estimates)
    assert len(set(estimates.values())) == 1, sorted(estimates)
