"""What goes down to the nodes in a session: learned step scales, and orders to leave."""

import time
from dataclasses import replace

import pytest

from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link.led_orders import LED_HEALTH, LED_ON, LedOrders
from relpos.link.orders import ATTEMPTS
from relpos.link.port import Link
from relpos.link.step_scale import IMPOSSIBLE, KNOWN_WELL, StepScaleSender
from relpos.measurements import Motion
from relpos.protocol import messages as wire
from relpos.simulation.team import SCENARIOS


class Conversation:
    """A team in memory with a sender at its port; keeps the newest motion of each node."""

    def __init__(self, team, sender=StepScaleSender, later_s=0.0):
        self.team, self.link = team, Link(clock=lambda: time.time() + later_s)
        self.sender = sender(self.link)
        self.motions = {}

    def run(self, until_s, step_us=50_000):
        while self.team.time_us < until_s * 1e6:
            for _, data in self.team.run(self.team.time_us + step_us):
                for observation in self.link.feed(data, self.team.time_us * 1e-6):
                    if isinstance(observation, Motion):
                        self.motions[observation.node] = observation
            while self.link.decoder.acknowledged:
                self.sender.handle(self.link.decoder.acknowledged.popleft())
            data = self.sender.due(self.team.time_us * 1e-6)
            if data:
                self.team.send(data)

    def learn(self, node, scale, sigma=0.01):
        self.sender.learn(node, scale, sigma, self.team.time_us * 1e-6)


def test_who_is_called_out_has_the_led_on_until_nobody_calls():
    straight = SCENARIOS["straight"]
    lossy = replace(straight.world, radio=replace(straight.world.radio, loss_probability=0.3))
    with EmulatedTeam(TeamConfig(replace(straight, world=lossy), 2, 60.0, 4)) as team:
        conversation = Conversation(team, LedOrders)
        conversation.run(3.0)
        conversation.sender.call_out([1, 77])
        conversation.run(12.0)
        # Node 77 is not there: it is asked seldom, and nobody waits for it.
        assert conversation.sender.lit() == [1]
        assert conversation.sender.lit() == []
        assert _led(conversation, 1, 20.0) == LED_ON
        assert _led(conversation, 2, 28.0) == LED_HEALTH
        conversation.sender.call_out([])
        conversation.run(34.0)
        assert conversation.sender.lit() == []
        assert _led(conversation, 1, 42.0) == LED_HEALTH


def test_an_order_of_a_new_session_is_not_taken_for_one_of_the_session_before():
    with EmulatedTeam(TeamConfig("straight", 2, 60.0, 4)) as team:
        before = Conversation(team, LedOrders)
        before.run(3.0)
        before.sender.call_out([1])
        before.run(5.0)
        before.sender.call_out([])
        before.run(7.0)
        anew = Conversation(team, LedOrders, later_s=60.0)
        anew.sender.call_out([1])
        anew.run(9.0)
        assert (before.sender.lit(), anew.sender.lit()) == ([1], [1])
        assert _led(anew, 1, 14.0) == LED_ON


def _led(conversation, node, until_s):
    return _in_force(conversation, node, (wire.CommandCode.SET_LED, 99), until_s)


def _in_force(conversation, node, order, until_s):
    """A node's setting: what it answers to a value out of range is the one in force."""
    answers = []
    asking = Asking(conversation.link, node, order, answers)
    sender, conversation.sender = conversation.sender, asking
    conversation.run(until_s)
    conversation.sender = sender
    return answers[-1].value


class Asking:
    """Gives a node an order again and again."""

    def __init__(self, link, node, order, answers):
        self.link, self.node, self.order, self.answers = link, node, order, answers
        self.next_s, self.tokens = 0.0, set()

    def due(self, now_s):
        if now_s < self.next_s:
            return b""
        self.next_s = now_s + 1.0
        token, data = self.link.command(self.node, *self.order)
        self.tokens.add(token)
        return data

    def handle(self, answer):
        if answer.token in self.tokens:
            self.answers.append(answer)


@pytest.fixture
def conversation():
    with EmulatedTeam(TeamConfig("straight", 2, 60.0, 3)) as team:
        yield Conversation(team)


def test_a_learned_scale_becomes_the_nodes_gain_and_a_new_gain_version(conversation):
    conversation.run(3.0)
    before = conversation.motions[1].gain_version
    conversation.learn(1, 1.10)
    conversation.run(8.0)
    (remark,) = conversation.sender.remarks
    assert remark == (
        "node 1: steps were counted 9 % too short and are right now, by the measured ranges; "
        "nothing to do"
    )
    assert conversation.sender.sent == 1
    assert conversation.motions[1].gain_version == (before + 1) % 256
    assert conversation.motions[2].gain_version == before
    order = (wire.CommandCode.SET_STEP_GAIN_PERMILLE, IMPOSSIBLE)
    assert _in_force(conversation, 1, order, 12.0) == 2354, "2140 in a new node"


@pytest.mark.parametrize(
    ("scale", "sigma"), [(1.02, 0.005), (1.10, 2.0 * KNOWN_WELL), (2.0, 0.01), (0.3, 0.01)]
)
def test_a_small_uncertain_or_impossible_scale_is_not_sent(conversation, scale, sigma):
    conversation.learn(1, scale, sigma)
    assert conversation.sender.due(0.0) == b""


def test_a_node_is_left_alone_until_the_estimator_has_learned_anew(conversation):
    conversation.run(3.0)
    conversation.learn(1, 1.10)
    conversation.run(8.0)
    conversation.learn(1, 1.10)
    assert conversation.sender.due(conversation.team.time_us * 1e-6) == b""


def test_a_node_that_does_not_answer_is_reported_and_nothing_waits_for_it(conversation):
    conversation.learn(77, 1.10)
    conversation.run(ATTEMPTS + 3.0)
    assert conversation.sender.sent == 0
    assert any("it does not answer" in r for r in conversation.sender.remarks)
    assert conversation.motions[1].time_s > ATTEMPTS


def test_the_gain_arrives_once_though_half_of_all_frames_are_lost():
    straight = SCENARIOS["straight"]
    lossy = replace(straight.world, radio=replace(straight.world.radio, loss_probability=0.5))
    with EmulatedTeam(TeamConfig(replace(straight, world=lossy), 1, 60.0, 4)) as team:
        conversation = Conversation(team)
        conversation.run(5.0)
        before = conversation.motions[1].gain_version
        conversation.learn(1, 0.9)
        conversation.run(40.0)
        assert conversation.sender.sent == 1
        assert (conversation.motions[1].gain_version - before) % 256 == 1
        assert team.radio.counts["lost"] > 5
