"""Every parser of foreign bytes against damaged input, shortly; `make fuzz` does it by coverage."""

import random
import time

import parser_fuzzer
import pytest


@pytest.mark.parametrize("times", [40, pytest.param(10_000, marks=pytest.mark.soak)])
@pytest.mark.parametrize("name", parser_fuzzer.TARGETS)
def test_a_parser_refuses_what_is_damaged_in_its_own_errors_and_soon(name, times, tmp_path):
    target, rng = parser_fuzzer.TARGETS[name](tmp_path), random.Random(1)
    for seed in target.seeds:
        target.read(seed)
    for _ in range(times):
        data = bytearray(rng.choice(target.seeds)[:4000])
        for _ in range(rng.randrange(1, 6)):
            at = rng.randrange(len(data) + 1)
            data[at : at + rng.randrange(4)] = rng.randbytes(rng.randrange(4))
        began_s = time.process_time()
        target.read(bytes(data))
        assert time.process_time() - began_s < parser_fuzzer.MOST_S


def test_what_fuzzing_once_found_is_refused(tmp_path):
    for path in sorted(parser_fuzzer.FINDINGS.glob("*-*")):
        folder = tmp_path / path.name
        folder.mkdir()
        parser_fuzzer.TARGETS[path.name.partition("-")[0]](folder).read(path.read_bytes())
