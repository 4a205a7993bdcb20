"""The vocabulary of faults: what is understood, what is refused and in which words."""

from dataclasses import replace
from pathlib import Path

import pytest

import fault_runs
import reliability
from relpos.emulator.faults import FAULTS, REFUSED, TARGETS, FaultError, help_text, parse_fault
from relpos.emulator.team import EmulatedTeam, TeamConfig
from support.command import relpos

NODES = (1, 2, 3)


def example(fault, node=2, begin=2.0, end=4.0):
    """A SPEC of ``fault`` for one node and for a while, where it takes those."""
    keys = fault.key_names()
    given = {"node": node, "from": begin, "to": end}
    pairs = [f"{name}={given[name]:g}" for name in keys if name in given]
    return fault.name + (":" + ",".join(pairs) if pairs else "")


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_can_be_written_and_happens(fault):
    spec = parse_fault(example(fault), NODES)
    assert spec.fault is fault
    assert spec.node == (None if fault.team else 2)
    with EmulatedTeam(TeamConfig("paper", NODES, 6.0, 1, faults=[spec])) as team:
        assert sum(len(data) for _, data in team.stream()) > 500


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_behaviour_without_code_is_an_error_and_never_another_behaviour(fault):
    spec = parse_fault(example(fault), NODES)
    uncoded = replace(spec, fault=replace(fault, behaviour="uncoded"))
    with pytest.raises(KeyError, match="uncoded"):
        EmulatedTeam(TeamConfig("paper", NODES, 6.0, 1, faults=[uncoded]))


@pytest.mark.parametrize(("target", "behaviour"), REFUSED, ids=":".join)
def test_a_combination_without_sense_is_refused_with_the_reason(target, behaviour):
    with pytest.raises(FaultError) as refused:
        parse_fault(f"{target}:{behaviour}:from=3")
    words = str(refused.value)
    assert REFUSED[target, behaviour] in words
    assert "\n" not in words
    allowed = [fault.behaviour for fault in FAULTS if fault.target == target]
    assert words.endswith(f"{target} can be {', '.join(allowed)}")


def test_refused_faults_are_not_offered():
    assert not {(fault.target, fault.behaviour) for fault in FAULTS} & set(REFUSED)
    assert {target for target, _ in REFUSED} <= set(TARGETS)


@pytest.mark.parametrize("target", ["imu", "magnetometer", "pozyx", "xbee", "clock"])
@pytest.mark.parametrize(
    "behaviour", ["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
)
def test_every_part_has_every_behaviour_or_a_reason_why_not(target, behaviour):
    offered = {(fault.target, fault.behaviour) for fault in FAULTS}
    assert ((target, behaviour) in offered) != ((target, behaviour) in REFUSED)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("", "unknown target ''"),
        ("gremlins:off", "unknown target 'gremlins': imu, magnetometer"),
        ("imu", "no behaviour given; imu can be off, stuck"),
        ("imu:stuk", "did you mean 'stuck'?"),
        ("imu:stuck:nod=2", "takes no 'nod'; its keys: node, from, to"),
        ("imu:stuck:node", "'node' is not KEY=VALUE"),
        ("imu:stuck:node=1,node=2", "'node' is given twice"),
        ("imu:stuck:node=two", "node is a whole number from 0 to 254, not 'two'"),
        ("imu:stuck:node=1.5", "a whole number"),
        ("imu:stuck:node=9", "there is no node 9; nodes: 1, 2, 3"),
        ("imu:stuck:node=0", "node 0 is the coordinator, which has no imu:stuck"),
        ("imu:stuck:from=nan", "from is a number from 0 to 86400, not 'nan'"),
        ("imu:stuck:from=9,to=3", "it ends at 3 s, before it begins at 9 s"),
        ("imu:garbage:value=12", "value is one of random, zeros, ones, not '12'"),
        ("radio:loss:rate=1.5", "rate is a number from 0 to 1, not '1.5'"),
        ("uwb:loss:node=1", "takes no 'node'; its keys: from, to, rate"),
        ("node:brownout:from=3,to=4", "takes no 'to'"),
        ("node:brownout", "happens at a moment: give from=SECONDS"),
    ],
)
def test_a_mistake_is_reported_in_one_line_that_says_what_is_allowed(spec, words):
    with pytest.raises(FaultError) as refused:
        parse_fault(spec, NODES)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("command", [("demo",), ("emulate", "--nodes", "3")])
def test_the_command_line_refuses_with_one_line_and_status_2(command):
    done = relpos(*command, "--fault", "clock:garbage")
    assert done.exit_code == 2
    assert done.stderr.startswith("relpos: fault 'clock:garbage': refused")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("command", ["demo", "emulate"])
def test_the_help_lists_every_fault_with_its_keys(command):
    done = relpos(command, "--help")
    shown = " ".join(done.stdout.split())
    for fault in FAULTS:
        assert fault.behaviour in shown.split(f"{fault.target} - ")[1]
    assert "collisions (rate)" in shown
    assert all(target in help_text() for target in TARGETS)


def test_the_same_faults_and_seed_give_the_same_bytes():
    faults = ["radio:bitflip:rate=0.5", "imu:intermittent:node=1", "uwb:collisions:from=1"]
    runs = []
    for _ in range(2):
        with EmulatedTeam(TeamConfig("paper", 2, 10.0, 3, faults=faults)) as team:
            runs.append(list(team.stream()))
    assert runs[0] == runs[1]
    with EmulatedTeam(TeamConfig("paper", 2, 10.0, 3)) as team:
        assert list(team.stream()) != runs[0]


def test_a_tag_that_sticks_twice_sticks_the_first_time_too():
    def bytes_with(*faults):
        with EmulatedTeam(TeamConfig("paper", 2, 10.0, 3, faults=faults)) as team:
            return list(team.stream())

    again = "pozyx:stuck:from=9"
    assert bytes_with("pozyx:stuck:from=3,to=8", again) != bytes_with(again)


def test_the_table_of_reliability_has_a_row_for_every_fault():
    page = Path(__file__).parents[2] / "docs" / "reliability.md"
    rows = [line for line in page.read_text().splitlines() if line.startswith("| `")]
    listed = [row.split("`")[1] for row in rows]
    assert listed == [spec for target in TARGETS for f, spec in fault_runs.specs()
                    if f.target == target]  # fmt: skip
    before = None
    for row, (fault, _) in zip(rows, sorted(
        fault_runs.specs(), key=lambda pair: list(TARGETS).index(pair[0].target)
    ), strict=True):  # fmt: skip
        cells = [cell.strip() for cell in row.strip("|").split(" | ")]
        assert len(cells) == 7
        assert cells[1] == ("" if fault is before else fault.meaning)
        assert cells[2] == ("" if before and before.must == fault.must else fault.must)
        before = fault
        assert cells[3].endswith(" s"), "recovers"
        if fault.target in ("radio", "xbee", "uwb", "pozyx", "host"):
            assert cells[4] == "0.00 m"


def test_a_row_that_is_printed_alone_can_be_pasted_into_the_table():
    page = (Path(__file__).parents[2] / "docs" / "reliability.md").read_text()
    (row,) = reliability.rows(("imu:stuck",))
    assert "|".join(row.split("|")[:4]) in page
