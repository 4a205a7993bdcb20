"""What `make lint` and `make wire-check` check, beside the other tests."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("target", ["lint", "wire-check"])
def test_the_sources_are_clean_and_the_generated_files_are_theirs(target):
    # This make is not a part of the one that runs the tests.
    alone = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    done = subprocess.run(
        ["make", target], cwd=ROOT, env=alone, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-5000:]
