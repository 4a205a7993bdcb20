"""The host against every frame but the right one: link_fuzzer.py, shortly and at length."""

import os
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import fuzz_builds
import link_fuzzer
import pytest

LONG_FRAMES = 10_000_000
GUIDED_FRAMES = 1_000_000


def test_a_foreign_frame_changes_nothing_in_the_host():
    """The short run: random scripts, without coverage."""
    source = random.Random(1)
    count: Counter[str] = Counter()
    while count["frames"] < 12_000:
        link_fuzzer.run_one(source.randbytes(600), count)
    assert min(count["mutants"], count["forged"], count["taken"]) > 1200
    assert count["refused"] > 4_000
    assert count["crc of mutants"] + count["crc of noise"] <= 5


@pytest.mark.soak
@pytest.mark.parametrize("part", range(4))
def test_ten_million_random_frames_change_nothing_in_the_host(part):
    source = random.Random(f"long {part}")
    count: Counter[str] = Counter()
    start_s = time.perf_counter()
    while count["frames"] < LONG_FRAMES // 4:
        link_fuzzer.run_one(source.randbytes(600), count)
    print(link_fuzzer.totals_line(count, start_s))
    fuzz_builds.check_that_only_the_crc_lets_noise_through(count)


@pytest.mark.soak
@pytest.mark.parametrize("part", [1, 2])
def test_a_million_frames_found_by_coverage_change_nothing_in_the_host(part, tmp_path):
    """Fewer than the random ones: what follows the branches takes five times as long a frame."""
    pytest.importorskip("atheris", reason="make soak installs it")
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    source = random.Random(part)
    for number in range(200):
        (corpus / str(number)).write_bytes(source.randbytes(source.randrange(20, 600)))
    program = Path(link_fuzzer.__file__)
    options = [f"-seed={part}", "-max_len=800", "-len_control=0", f"-artifact_prefix={tmp_path}/"]
    result = subprocess.run(
        [sys.executable, program, str(GUIDED_FRAMES // 2), *options, corpus],
        capture_output=True,
        text=True,
        errors="replace",
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        check=False,
    )
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
    print(result.stdout.splitlines()[-1])
    count = fuzz_builds.totals(result.stdout)
    assert count["frames"] >= GUIDED_FRAMES // 2
    fuzz_builds.check_that_only_the_crc_lets_noise_through(count)
