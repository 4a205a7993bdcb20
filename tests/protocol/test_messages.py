"""Messages: each has a golden frame, fits one, and counters wrap."""

import json
import re
import runpy
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpos.protocol import messages as wire

ROOT = Path(__file__).parents[2]
VECTORS = json.loads((ROOT / "protocol" / "vectors" / "frames.json").read_text())


def test_every_frame_fits_the_66_bytes_that_all_radio_modules_carry():
    for message in wire.MESSAGES:
        overhead = wire.HEADER_BYTES + wire.CRC_BYTES + wire.TAG_BYTES
        assert overhead + message.most_bytes <= 66, message.name


def test_every_message_type_has_a_golden_frame():
    assert {v["message"] for v in VECTORS} == {m.name for m in wire.MESSAGES}


@given(st.data())
@settings(max_examples=200)
def test_differences_survive_the_wrap_of_every_counter(data):
    message = data.draw(st.sampled_from(wire.MESSAGES))
    counters = [f for f in message.fields if f.wraps]
    if not counters:
        return
    field = data.draw(st.sampled_from(counters))
    older = data.draw(st.integers(field.wrap(field.modulus // 2), field.modulus - 1))
    ahead = data.draw(st.integers(-(field.modulus // 2), field.modulus // 2 - 1))
    older_value = field.wrap(older) / field.per_unit
    newer_value = field.wrap(older + ahead) / field.per_unit
    assert field.difference(newer_value, older_value) == pytest.approx(
        ahead / field.per_unit, abs=0.01 / field.per_unit
    )


def test_a_commit_of_any_generated_file_checks_them_all():
    hooks = (ROOT / ".pre-commit-config.yaml").read_text()
    (files,) = re.findall(r"id: wire\n(?:.*\n)*?\s+files: (.*)", hooks)
    outputs = runpy.run_path(str(ROOT / "protocol" / "generate.py"))["outputs"]()
    for path in outputs:
        assert re.search(files, path.relative_to(ROOT).as_posix()), path
