"""The end of a session: after Ctrl-C nobody waits for what is not needed."""

from __future__ import annotations

import ctypes
import io
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from multiprocessing import resource_tracker
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.core import TyperGroup
from typer.testing import CliRunner

import relpos
from relpos import fusion
from relpos.cli import fuse, live
from relpos.cli.main import app
from relpos.errors import interrupts_kept
from relpos.fusion import kernel_cache
from relpos.live.session import Outcome
from relpos.nodes.boards import BOARDS
from support.waiting import until

TEAM: Any = SimpleNamespace(name="/dev/pts/9", is_now=True)


def test_a_session_that_is_ended_does_not_ask_whether_its_emulated_walk_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "run", lambda *_: Outcome())
    asked: list[bool] = []

    def over() -> bool:  # It waits for the emulator's process.
        asked.append(True)
        return True

    job = fuse.Job("emulated", "bank", {}, 0, tmp_path)
    fuse.fuse_live(job, TEAM, live.Options(), as_json=False, emulated=over)
    assert asked == []


def test_a_second_ctrl_c_leaves_the_debrief_for_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(live, "run", lambda *_: Outcome(estimates=1))
    monkeypatch.setattr("relpos.api.load", interrupted)
    job = fuse.Job("emulated", "bank", {}, 0, tmp_path)
    fuse.fuse_live(job, TEAM, live.Options(view=True), as_json=False)
    said = capsys.readouterr().err
    assert f"relpos report {tmp_path / 'received'} --estimate {tmp_path}" in said


def test_closed_outputs_are_no_traceback(tmp_path: Path) -> None:
    run, folder = relpos.simulate("paper", 1, seconds=10), str(tmp_path)
    relpos.save(run, folder)
    relpos.fuse(run, "deadreckoning").save(folder)
    command = [sys.executable, "-m", "relpos", "evaluate", folder, "--estimate", folder]
    no_stdout = subprocess.run(
        ["sh", "-c", 'exec "$@" >&-', "sh", *command], stderr=subprocess.PIPE, text=True
    )
    assert (no_stdout.returncode, no_stdout.stderr) == (0, "")
    neither = subprocess.run(["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *command])
    assert neither.returncode == 0


@pytest.mark.parametrize(
    ("where", "raised", "said"),
    [
        ("parse_args", KeyboardInterrupt, "relpos: interrupted\n"),
        ("invoke", KeyboardInterrupt, "relpos: interrupted\n"),
        ("invoke", MemoryError, "relpos: not enough memory: a shorter run, or fewer nodes\n"),
    ],
)
def test_whatever_ends_a_command_is_one_line(
    monkeypatch: pytest.MonkeyPatch, where: str, raised: type[BaseException], said: str
) -> None:
    def ended(*_: object, **__: object) -> None:
        raise raised

    monkeypatch.setattr(TyperGroup, where, ended)
    result = CliRunner().invoke(app, ["doctor"])
    assert (result.exit_code, result.stderr) == (1, said)


def test_ctrl_c_is_no_traceback_of_a_process_that_still_starts() -> None:
    with interrupts_kept():
        process = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60.0,))
        process.start()
    assert process.pid is not None
    time.sleep(0.1)  # It imports: what ignores Ctrl-C in its first line does not yet.
    os.kill(process.pid, signal.SIGINT)
    process.join(3.0)
    assert process.is_alive()
    process.kill()
    process.join()
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())


def test_a_ctrl_c_within_a_callback_of_the_compiler_s_library_is_not_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @ctypes.CFUNCTYPE(None)
    def called_back() -> None:  # What is raised here is printed, and goes on as if nothing were.
        signal.raise_signal(signal.SIGINT)

    rehearsed: list[str] = []

    def rehearse(room: str, _: int) -> None:
        rehearsed.append(room)
        called_back()

    monkeypatch.setattr(kernel_cache, "is_complete", lambda rooms: True)
    monkeypatch.setattr(fusion, "rehearse", rehearse)
    # Whatever started these tests may ignore it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            fusion.warm_up("bank")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(rehearsed) == 1


@pytest.mark.parametrize(
    ("number", "before"),
    [
        (signal.SIGINT, ""),
        (signal.SIGTERM, ""),
        (signal.SIGTERM, "trap '' INT; "),  # as in the background of a script
    ],
)
def test_sigterm_ends_a_session_in_the_words_of_ctrl_c(
    tmp_path: Path, number: signal.Signals, before: str
) -> None:
    folder = tmp_path / "mill"
    command = [sys.executable, "-m", "relpos", "mission", str(folder), "loop://"]
    options = ["--estimator", "deadreckoning", "--no-open", "--view-listen", "127.0.0.1:0"]
    process = subprocess.Popen(
        ["sh", "-c", f'{before}exec "$@"', "sh", *command, *options],
        stderr=subprocess.PIPE,
        text=True,
    )
    log = folder / "journal.jsonl"
    until(lambda: log.exists() and "no node is heard" in log.read_text(), "it does not begin")
    process.send_signal(number)
    _, said = process.communicate(timeout=60.0)
    assert "relpos: no motion was received: nothing can be estimated" in said
    assert process.returncode == 1


def test_ctrl_c_ends_the_processes_that_compile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resource_tracker.ensure_running()  # it has to be a true Python's
    compiler, ledger = tmp_path / "python", tmp_path / "started"
    ledger.touch()
    compiler.write_text(f"#!/bin/sh\necho $$ >> {ledger}\nexec sleep 60\n")
    compiler.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(compiler))
    monkeypatch.setattr(kernel_cache, "is_complete", lambda rooms: False)

    def interrupted(*_: object) -> None:
        while len(started := ledger.read_text().split()) < len(rooms):
            time.sleep(0.01)
        pids.extend(map(int, started))
        raise KeyboardInterrupt

    pids: list[int] = []
    rooms = fusion.ROOMS["particle"]
    with pytest.raises(KeyboardInterrupt):
        fusion.warm_up("particle", interrupted)
    assert pids
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.parametrize("empty", [("--out", ""), ("--out=",)])
def test_an_empty_argument_is_not_the_folder_where_one_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, empty: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["simulate", "--scenario", "paper", "--seed", "1", *empty]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2
    assert "empty" in result.stderr
    assert not list(tmp_path.iterdir())


def test_a_link_to_itself_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    relpos.save(relpos.simulate("paper", 1, seconds=5), tmp_path / "run")
    command = ["convert", str(tmp_path / "run"), "--to", "run", "--out", str(tmp_path / "loop")]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == 1
    assert "loop" in result.stderr


def test_ctrl_c_while_a_board_is_flashed_says_what_the_board_is_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("relpos.link.port.open_port", lambda *_: io.BytesIO())
    monkeypatch.setattr("relpos.nodes.boards.check", lambda *_: BOARDS["uno"])
    monkeypatch.setattr("relpos.nodes.upload.upload", interrupted)
    result = CliRunner().invoke(app, ["node", "flash", "/dev/ttyACM0"])
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1] == (
        "relpos: /dev/ttyACM0: interrupted: the board may hold half of the firmware; flash it again"
    )
