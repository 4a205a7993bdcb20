"""The firmware's C++ suites, run by PlatformIO: here, under sanitizers, on a simulated Uno."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 600


@pytest.mark.parametrize(
    "environments",
    [("native_sanitized", "uno_sim"), pytest.param(("native",), marks=pytest.mark.soak)],
    ids=" ".join,
)
def test_every_suite_passes(environments):
    chosen = [word for environment in environments for word in ("-e", environment)]
    done = subprocess.run(
        [ROOT / "tools" / "pio", "test", *chosen],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-5000:]
    (cases, succeeded) = re.findall(r"(\d+) test cases: (\d+) succeeded", done.stdout)[-1]
    assert cases == succeeded
    assert int(cases) >= 80 * len(environments)
