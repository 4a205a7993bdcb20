"""The order of the files: the longest first, so that no worker is left alone at the end.

Files whose tests wait, for browsers, boards and clocks, are spread evenly among those that compute:
both together keep the cores busy from the first minute to the last.

Examples of Hypothesis have no time limit: they would fail where the machine is busy.
"""

from __future__ import annotations

import gc
import os
from functools import cache
from itertools import accumulate

import pytest
import typer.testing
from hypothesis import settings

settings.register_profile("relpos", deadline=None)
settings.load_profile("relpos")

# Nothing of what is imported and collected is ever freed: not to be searched again and again.
gc.disable()

# `CliRunner` would put the whole command line together for each call, which takes longer than most.
typer.testing._get_command = cache(typer.testing._get_command)

DURATIONS = "relpos/durations"
"""Key in pytest's cache: file -> seconds that its tests took the last time."""

LONG = (
    "tests/view/",
    "tests/firmware/",
    "tests/nodes/test_node_check",
    "tests/architecture/test_lint",
)
"""What takes minutes: in a fresh clone, where nothing was measured, it comes first."""

WAITING = (
    "tests/view/",
    "tests/system/",
    "tests/nodes/",
    "tests/live/",
    "tests/docs/test_doc_commands",
    "tests/recording/test_recording_crash",
)
"""What leaves a core idle for half of its time."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Two a core: while tests wait for browsers and processes, the cores stay busy.

    Each more costs its imports, its collecting and its kernels: eight seconds of processor time.
    """
    return 2 * (os.cpu_count() or 1)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    cache = _cache_of(config)
    durations = cache.get(DURATIONS, {}) if cache is not None else {}
    # Tests of a file stay together and share its fixtures (--dist loadfile); a new one may be long.
    files = {_file_of(item.nodeid): _guess_s(item.nodeid) for item in items} | durations
    longest_first = sorted(files, key=lambda file: -files[file])
    place: dict[str, float] = {}  # Share of what waits, or of what computes, that begins before.
    for waits in (True, False):
        alike = [file for file in longest_first if file.startswith(WAITING) is waits]
        before = accumulate((files[file] for file in alike), initial=0.0)
        whole = sum(files[file] for file in alike)
        place |= {file: begun / (whole or 1) for file, begun in zip(alike, before, strict=False)}
    items.sort(key=lambda item: place[_file_of(item.nodeid)])


def pytest_collection_finish() -> None:
    gc.freeze()
    # Tests make many objects that die young: seldom searched, they cost 3 % less processor time.
    gc.set_threshold(50_000)
    gc.enable()


def _cache_of(config: pytest.Config) -> pytest.Cache | None:
    return getattr(config, "cache", None)  # Absent with `-p no:cacheprovider`.


def _guess_s(nodeid: str) -> float:
    return 120.0 if nodeid.startswith(LONG) else 60.0


def _file_of(nodeid: str) -> str:
    return nodeid.partition("::")[0]


class _Stopwatch:
    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.seconds: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        file = _file_of(report.nodeid)
        self.seconds[file] = self.seconds.get(file, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        """Keep what this run measured; a run of a few files keeps the others' figures."""
        cache = _cache_of(self.config)
        if cache is not None:
            cache.set(DURATIONS, cache.get(DURATIONS, {}) | self.seconds)


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Stopwatch(config))
