"""Every parser of foreign bytes against damaged input, shortly; `make fuzz` does it by coverage."""

import random

import parser_fuzzer
import pytest

TIMES = 40


@pytest.mark.parametrize("name", parser_fuzzer.TARGETS)
def test_a_parser_refuses_what_is_damaged_in_its_own_errors(name, tmp_path):
    target, rng = parser_fuzzer.TARGETS[name](tmp_path), random.Random(1)
    for seed in target.seeds:
        target.read(seed)
    for _ in range(TIMES):
        data = bytearray(rng.choice(target.seeds)[:4000])
        for _ in range(rng.randrange(1, 6)):
            at = rng.randrange(len(data) + 1)
            data[at : at + rng.randrange(4)] = rng.randbytes(rng.randrange(4))
        target.read(bytes(data))


def test_what_fuzzing_once_found_is_refused(tmp_path):
    for path in sorted(parser_fuzzer.FINDINGS.glob("*-*")):
        folder = tmp_path / path.name
        folder.mkdir()
        parser_fuzzer.TARGETS[path.name.partition("-")[0]](folder).read(path.read_bytes())
