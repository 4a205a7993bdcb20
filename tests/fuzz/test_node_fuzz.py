"""The node against every frame but the right one: node_fuzzer.cpp, shortly and at length."""

import os
import random
import subprocess

import fuzz_builds
import pytest

LONG_FRAMES = 10_000_000


def run(program, *arguments, frames=None, timeout_s=None):
    environment = dict(os.environ)
    if frames is not None:
        environment["RELPOS_FUZZ_FRAMES"] = str(frames)
    result = subprocess.run(
        [program, *map(str, arguments)],
        capture_output=True,
        text=True,
        errors="replace",
        env=environment,
        check=False,
        timeout=timeout_s,
    )
    assert result.returncode == 0, result.stderr[-6000:]
    line = result.stdout.splitlines()[-1]
    print(line)
    return fuzz_builds.totals(result.stdout)


def test_forty_thousand_frames_change_nothing_that_their_key_does_not_allow():
    count = run(fuzz_builds.build(fuzz_builds.RANDOM), 40_000, 1)
    assert count["frames"] >= 40_000
    # The run reached what it is about.
    assert min(count["mutants"], count["forged"], count["obeyed"], count["refused"]) > 4_000
    assert count["restarts"] > 400
    assert count["noise"] > 1200
    fuzz_builds.check_that_only_the_crc_lets_noise_through(count)


@pytest.mark.soak
def test_ten_million_frames_found_by_coverage_change_nothing(tmp_path):
    program = fuzz_builds.build(fuzz_builds.GUIDED)
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    source = random.Random(1)
    for number in range(200):
        (corpus / str(number)).write_bytes(source.randbytes(source.randrange(20, 600)))
    options = ("-seed=1", "-max_len=800", "-len_control=0", f"-artifact_prefix={tmp_path}/")
    count = run(program, *options, corpus, frames=LONG_FRAMES)
    assert count["frames"] >= LONG_FRAMES
    fuzz_builds.check_that_only_the_crc_lets_noise_through(count)


@pytest.mark.soak
def test_ten_million_random_frames_change_nothing():
    count = run(fuzz_builds.build(fuzz_builds.RANDOM), LONG_FRAMES, 2)
    assert count["noise"] / 2**16 > 5  # enough to compare
    assert count["crc of noise"] >= 1
    fuzz_builds.check_that_only_the_crc_lets_noise_through(count)
