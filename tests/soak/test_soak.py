"""The soak's oracle: quiet over a short episode, and not blind. `make soak` runs many."""

import pytest
from oracle import ViolationError

import soak
from relpos.link.authentication import CounterWindow, Verdict
from relpos.link.decoder import Decoder


def test_an_episode_of_everything_breaks_no_promise(tmp_path):
    assert soak.episode(18, "deadreckoning", tmp_path).team_s > 25.0


def accept_again(monkeypatch):
    monkeypatch.setattr(CounterWindow, "check", lambda *_: Verdict.NEW)


def lose_a_count(monkeypatch):
    monkeypatch.setattr(Decoder, "_link_status", lambda self, node, track, time_s: (
        track.counts.update(lost=1) or []))  # fmt: skip


def turn_the_wrong_way(monkeypatch):
    plain = Decoder._motion

    def motion(self, node, track, values):
        return plain(self, node, track, values | {"y_m": -values["y_m"]})

    monkeypatch.setattr(Decoder, "_motion", motion)


@pytest.mark.parametrize(
    ("spoil", "promise"),
    [
        (accept_again, "accepted twice|goes on in time|taken from an attacker"),
        (lose_a_count, "sent = received"),
        (turn_the_wrong_way, "adds up"),
    ],
)
def test_the_oracle_sees_a_broken_promise(monkeypatch, tmp_path, spoil, promise):
    spoil(monkeypatch)
    with pytest.raises(ViolationError, match=promise):
        soak.episode(18, "deadreckoning", tmp_path)
