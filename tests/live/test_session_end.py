"""A session that somebody ends on the page: who asked is answered, and everybody told."""

from __future__ import annotations

from team_input import TeamInput, make_session, run_through

from relpos import fusion
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.live.requests import Request
from relpos.live.sinks import Sink
from relpos.live.team_view import TeamView


class Commander(Sink):
    """Ends it after five seconds."""

    def __init__(self, source: TeamInput) -> None:
        self.source = source
        self.asked = False
        self.answer: int | None = None
        self.views: list[TeamView] = []

    def updated(self, view: TeamView) -> None:
        self.views.append(view)

    def requests(self) -> list[Request]:
        if self.asked or self.source.now_s() < 5.0:
            return []
        self.asked = True
        return [Request(1, "end", 0.0, {"by": "Anna"})]

    def respond(self, request: Request, reply: dict[str, object], status: int = 200) -> None:
        self.answer = status


def test_the_session_ends_when_a_commander_says_so() -> None:
    with EmulatedTeam(TeamConfig("straight", 2, 30.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        commander = Commander(source)
        session, _ = make_session(
            source,
            lambda priors: fusion.make("deadreckoning", priors),
            commander,
            priors=team.priors(),
        )
        outcome = run_through(session)
    assert outcome.failure is None
    assert commander.answer == 200
    assert 5.0 <= commander.views[-1].time_s < 10.0
    texts = [notice.text for notice in commander.views[-1].notices]
    assert "the session was ended by Anna" in texts
