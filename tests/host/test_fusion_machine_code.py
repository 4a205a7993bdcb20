"""Who compiles kernels, and what that does to estimates."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from relpos.fusion import machine_code

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


def test_kernels_are_kept_once_each_was_compiled_since_it_was_changed(tmp_path: Path) -> None:
    version = "".join(map(str, sys.version_info[:2]))
    for module in machine_code.KERNELS:
        assert not machine_code.is_kept([tmp_path])
        (tmp_path / f"{module}.f-1.py{version}.nbi").touch()
    assert machine_code.is_kept([tmp_path])
    os.utime(tmp_path / f"joint.f-1.py{version}.nbi", (0.0, 0.0))
    assert not machine_code.is_kept([tmp_path])


@pytest.mark.soak
def test_the_first_start_after_an_installation_gives_the_estimates_of_every_later_one(
    tmp_path: Path,
) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", FUSE], env=environment, capture_output=True, check=True
        ).stdout
        for _ in range(2)
    )
    assert first == second
