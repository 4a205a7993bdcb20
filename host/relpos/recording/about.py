"""The description of a session in its recording: enough to repeat it, never the key."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from relpos.errors import DataError
from relpos.protocol import messages as wire
from relpos.runs.description import Description, description_text, parse_description
from relpos.version import __version__

METADATA = "relpos"
DESCRIPTION = "run.toml"
MOST = (1 << 63) - 1


@dataclass(frozen=True)
class About:
    """A session: when it began, and how its inputs were fused.

    ``started_unix_ns`` is Unix time at the session's second 0. ``own_key``: the team has another
    key than the one that every new node has; the key itself is not recorded.
    ``newest_counters``: of each node before the session, nothing up to it was taken. ``resumed``:
    it went on from a session before, whose totals of the nodes are not in this recording.
    """

    started_unix_ns: int
    source: str = ""
    estimator: str = "bank"
    settings: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    initial: str | None = None
    own_key: bool = False
    newest_counters: Mapping[int, int] = field(default_factory=dict)
    resumed: bool = False
    description: Description = field(default_factory=Description)
    """Names, mounting and known starts of the nodes, as in ``run.toml``."""
    version: str = ""
    protocol: int = 0
    part: int = 1

    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name."""
        return {
            METADATA: {
                "relpos_version": self.version or __version__,
                "protocol_version": str(self.protocol or wire.PROTOCOL_VERSION),
                "started_unix_ns": str(self.started_unix_ns),
                "part": str(self.part),
                "source": self.source,
                "estimator": self.estimator,
                "settings": json.dumps(dict(self.settings)),
                "seed": str(self.seed),
                "initial": self.initial or "",
                "own_key": "true" if self.own_key else "false",
                "newest_counters": json.dumps(dict(self.newest_counters)),
                "resumed": "true" if self.resumed else "false",
            },
            DESCRIPTION: {"text": description_text(self.description)},
        }

    @classmethod
    def read(cls, where: str, records: Mapping[str, Mapping[str, str]]) -> About | None:
        """Read the metadata; None for a recording of another program. DataError if damaged."""
        values = records.get(METADATA)
        if values is None:
            return None
        try:
            counters: dict[str, int] = json.loads(values.get("newest_counters", "{}"))
            settings: dict[str, str] = json.loads(values.get("settings", "{}"))
            started_unix_ns, seed = int(values["started_unix_ns"]), int(values.get("seed", "0"))
            if max(started_unix_ns, seed) > MOST or min(started_unix_ns, seed) < 0:
                raise ValueError(f"a start or a seed that is none of 0 to {MOST}")
            return cls(
                started_unix_ns=started_unix_ns,
                source=values.get("source", ""),
                estimator=values.get("estimator", "bank"),
                settings={str(key): str(value) for key, value in settings.items()},
                seed=seed,
                initial=values.get("initial") or None,
                own_key=values.get("own_key") == "true",
                newest_counters={int(node): int(n) for node, n in counters.items()},
                resumed=values.get("resumed") == "true",
                description=parse_description(
                    f"{where}: {DESCRIPTION}", records.get(DESCRIPTION, {}).get("text", "")
                ),
                version=values.get("relpos_version", ""),
                protocol=int(values.get("protocol_version", "0")),
                part=int(values.get("part", "1")),
            )
        except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise DataError(f"{where}: what it says of its session is damaged: {error!r}") from None
