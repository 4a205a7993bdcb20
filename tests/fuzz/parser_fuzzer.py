"""Coverage-guided fuzzing of everything that reads foreign bytes, on the host and on the node.

    python tests/fuzz/parser_fuzzer.py [--minutes 1 | --runs N] [--target NAME ...]

Each parser gets inputs that libFuzzer (on the host by atheris) derives from valid ones, in a
process of its own with a limit of memory and of time an input. A parser may refuse in its own
errors and do nothing else. The firmware's, "wire" (line, frames, bodies, EEPROM) and "node" (the
whole node), run under sanitizers. The corpus is kept in .build/fuzz/corpus, a finding in
.build/fuzz/findings; once it is mended it belongs to tests/fuzz/findings, which
test_parser_fuzz.py reads.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / ".build" / "fuzz" / "corpus"
FOUND = ROOT / ".build" / "fuzz" / "findings"
FINDINGS = Path(__file__).with_name("findings")
MOST_MB = 1536
MOST_S = 10
INTERRUPTED = 72
"""libFuzzer's exit code after a signal."""

sys.path += [str(ROOT / "tests" / "live"), str(ROOT / "tests" / "fuzz")]


OPEN = contextlib.ExitStack()
"""What stays open while a target is called."""


class Target:
    """A parser: its valid inputs, the modules whose branches are followed, and a call."""

    def __init__(self, read: Callable[[bytes], None], seeds: list[bytes], *modules: str) -> None:
        self.read, self.seeds, self.modules = read, seeds, modules


def a_run(folder: Path) -> dict[str, bytes]:
    """The files of a small valid run with estimates."""
    from relpos import api
    from relpos.runs import save_run, write_estimates

    simulated = api.simulate("paper", seed=1)
    save_run(simulated, folder / "run")
    write_estimates(folder / "run", api.fuse(simulated, "deadreckoning").estimates)
    return {p.name: p.read_bytes()[:3000] for p in (folder / "run").iterdir() if p.is_file()}


def files(folder: Path) -> Target:
    """A run directory of which one file is foreign: its name, a zero byte, its content."""
    from relpos.errors import RelposError
    from relpos.runs import load_run, read_estimates

    valid = a_run(folder)
    place = folder / "foreign"
    place.mkdir()
    for name, content in valid.items():
        (place / name).write_bytes(content)

    def read(data: bytes) -> None:
        number, content = data[:1], data[1:]
        name = sorted(valid)[number[0] % len(valid)] if number else "run.toml"
        (place / name).write_bytes(content)
        try:
            for reader in (load_run, read_estimates):
                with contextlib.suppress(RelposError):
                    reader(place)
        finally:
            (place / name).write_bytes(valid[name])

    seeds = [bytes((k,)) + valid[name] for k, name in enumerate(sorted(valid))]
    return Target(read, seeds, "relpos.runs")


def toml(folder: Path) -> Target:
    """The description of a run."""
    from relpos.errors import RelposError
    from relpos.runs.description import parse_description

    def read(data: bytes) -> None:
        with contextlib.suppress(RelposError):
            parse_description("run.toml", data.decode("utf-8", "replace"))

    person = b'[node.1]\nname = "Kim"\nx_m = 0.0\ny_m = 1.0\nsigma_m = 1.0\n'
    seeds = [b'name = "a"\nstature_m = 1.8\n' + person, a_run(folder)["run.toml"]]
    return Target(read, seeds, "relpos.runs.description")


def mcap(folder: Path) -> Target:
    """A recording."""
    import lzma

    from relpos.errors import RelposError
    from relpos.recording import open_recording
    from relpos.recording.moments import Moments
    from relpos.recording.player import Player
    from relpos.recording.replay import Replay

    path = folder / "foreign.mcap"

    def read(data: bytes) -> None:
        path.write_bytes(data)
        with contextlib.suppress(RelposError):
            recording = open_recording(path)
            replay = Replay(recording, bytes(16))
            recording.run_of(replay.observations())
        with contextlib.suppress(RelposError), contextlib.closing(Moments([path])) as moments:
            player = Player(moments, [])
            player.wait()
            assert player.history.complete
            player.view(moments.to_s).to_json()

    golden = lzma.decompress((ROOT / "tests" / "golden" / "0.2.0.mcap.xz").read_bytes())
    return Target(read, [golden[:20_000], golden[-8_000:]], "relpos.recording")


def settings(_: Path) -> Target:
    """What is typed: settings of nodes, faults, settings of estimators, key files."""
    from relpos import fusion
    from relpos.emulator.faults import parse_fault
    from relpos.errors import RelposError
    from relpos.nodes.settings import parse_changes

    def read(data: bytes) -> None:
        words = data.decode("utf-8", "replace").split("\n")
        with contextlib.suppress(ValueError):
            parse_changes(words)
        for word in words:
            with contextlib.suppress(RelposError):
                parse_fault(word, [1, 2, 3])
            name, _, value = word.partition("=")
            with contextlib.suppress(RelposError):
                fusion.check("bank", {name: value})

    seeds = [
        b"stature\n1.78\nled\noff\nreport-period=0.5",
        b"radio:foreign:from=25,to=45,key=stolen",
        b"pair_bias_m=0.3\nimu:wrong:node=2,value=1e3",
    ]
    return Target(read, seeds, "relpos.nodes.settings", "relpos.emulator.faults", "relpos.fusion")


def http(folder: Path) -> Target:
    """Requests of guests: a route, and its body."""
    import json

    from house import BODIES, WELL, open_house

    house = OPEN.enter_context(open_house(folder))
    routes = sorted(BODIES)

    def read(data: bytes) -> None:
        path = routes[data[0] % len(routes)] if data else routes[0]
        answer = house.send("POST", path, data[1:])
        assert answer.status_code in WELL, answer.text
        assert not house.live._failed, house.live._failed

    seeds = [bytes((k,)) + json.dumps(BODIES[r]).encode() for k, r in enumerate(routes)]
    return Target(read, seeds, "relpos.view.server", "relpos.live")


def websocket(folder: Path) -> Target:
    """A guest's WebSocket, zero bytes between: path, query, four headers, what it sends."""
    from house import open_house

    house = OPEN.enter_context(open_house(folder))
    names = (b"host", b"origin", b"cookie", b"accept")

    def read(data: bytes) -> None:
        parts = data.split(b"\0")
        parts += [b""] * (6 - len(parts))
        path, query, *rest = parts
        head = [(name, value) for name, value in zip(names, rest, strict=False) if value]
        messages = [
            {"bytes": part} if part[:1] == b"b" else {"text": part.decode()}
            for part in rest[len(names) :]
            if part[:1] == b"b" or part.isascii()
        ]
        house.meet(path.decode("utf-8", "replace"), query, head, messages)
        assert not house.live._failed, house.live._failed

    cookie = b"; ".join(b"%s=%s" % (a.encode(), b.encode()) for a, b in house.cookies.items())
    host, token = b"localhost:8460", cookie.partition(b"=")[2]
    seeds = [
        b"\0".join((b"/ws", b"", host, b"http://" + host, cookie, b"", b"{}", b"b\xff", b"[[")),
        b"\0".join((b"/ws", b"token=" + token, b"[::1]:8460", b"", b"", b"*/*", b"hello")),
        b"\0".join((b"/static/page.js", b"token=a", host, b"null", b"a=b; c", b"", b"b")),
    ]
    return Target(read, seeds, "relpos.view.server", "relpos.view.guard", "relpos.view.access")


def link(_: Path) -> Target:
    """Scripts of frames: link_fuzzer.py."""
    import random
    from collections import Counter

    import link_fuzzer

    source = random.Random(1)
    seeds = [source.randbytes(source.randrange(20, 600)) for _ in range(100)]
    return Target(
        lambda data: link_fuzzer.run_one(data, Counter()), seeds, "relpos.link", "relpos.protocol"
    )


FIRMWARE = {"wire": 100, "node": 800}
"""Of each fuzzer of the firmware, NAME_fuzzer.cpp, the most bytes of an input."""
TARGETS = {make.__name__: make for make in (files, toml, mcap, settings, http, websocket, link)}


def follow_branches(modules: tuple[str, ...]) -> None:
    """Let libFuzzer see the branches of these modules' functions."""
    import atheris

    for module_name, module in list(sys.modules.items()):
        if not any(module_name == m or module_name.startswith(m + ".") for m in modules):
            continue
        for name, value in list(vars(module).items()):
            if getattr(value, "__module__", None) != module_name:
                continue
            if isinstance(value, type):
                for inner, method in list(vars(value).items()):
                    if hasattr(method, "__code__"):
                        with contextlib.suppress(AttributeError, TypeError):
                            setattr(value, inner, atheris.instrument_func(method))
            elif hasattr(value, "__code__"):
                setattr(module, name, atheris.instrument_func(value))


def run_target(name: str, options: list[str]) -> None:
    """In a process of its own; libFuzzer ends it."""
    import atheris

    with tempfile.TemporaryDirectory() as folder:
        target = TARGETS[name](Path(folder))
        corpus = KEPT / name
        corpus.mkdir(parents=True, exist_ok=True)
        for number, seed in enumerate(target.seeds):
            (corpus / f"seed-{number}").write_bytes(seed)
        follow_branches(target.modules)
        atheris.Setup([sys.argv[0], *options, str(corpus)], target.read)
        atheris.Fuzz()


def fuzz(name: str, ending: str) -> bool:
    """Fuzz one parser; print its line. Return whether nothing was found."""
    FOUND.mkdir(parents=True, exist_ok=True)
    options = [
        ending, f"-rss_limit_mb={MOST_MB}", f"-timeout={MOST_S}",
        f"-max_len={FIRMWARE.get(name, 24_000)}", "-print_final_stats=1",
        f"-artifact_prefix={FOUND}/{name}-",
    ]  # fmt: skip
    if name in FIRMWARE:
        command, environment = firmware(name), FIRMWARE_ENVIRONMENT
        again = f"{command[0]} FILE" if command else ""
    else:
        command, environment = [sys.executable, __file__, "--child", name], {}
        again = f"python {Path(__file__).relative_to(ROOT)} --child {name} FILE"
    if not command:
        print(f"{name}: not fuzzed, there is no clang++ (make soak tries the node at random)")
        return True
    done = subprocess.run(
        [*command, *options],
        capture_output=True, text=True, errors="replace", check=False,
        env=os.environ | environment,
    )  # fmt: skip
    said = done.stdout + done.stderr
    runs = re.findall(r"number_of_executed_units:\s*(\d+)", said)
    executed = re.findall(r"^#(\d+)\s.*cov: (\d+)", said, re.M)
    parts = re.findall(r"^line \d+, .*$", said, re.M)
    count, cover = (runs or ["?"])[-1], (executed or [("?", "?")])[-1][1]
    well = {0: "well", INTERRUPTED: "stopped"}.get(done.returncode, "FOUND")
    print(f"{name}: {count} inputs, {cover} branches, {', '.join([*parts, well])}", flush=True)
    if well == "FOUND":
        print(said[-3000:])
        print(f"again: {again}")
    return well != "FOUND"


FIRMWARE_ENVIRONMENT = {
    "ASAN_OPTIONS": "malloc_context_size=1:quarantine_size_mb=16",
    "RELPOS_FUZZ_FRAMES": str(1 << 62),
}


def firmware(name: str) -> list[str]:
    """Build a fuzzer of the firmware; its command and corpus. Nothing without clang++."""
    import fuzz_builds

    if shutil.which("clang++") is None:
        return []
    corpus = KEPT / name
    corpus.mkdir(parents=True, exist_ok=True)
    if not any(corpus.iterdir()):
        source, most = random.Random(1), FIRMWARE[name]
        for number in range(200):
            (corpus / str(number)).write_bytes(source.randbytes(source.randrange(1, most)))
    return [str(fuzz_builds.build(fuzz_builds.GUIDED, f"{name}_fuzzer.cpp")), str(corpus)]


def main() -> int:
    """Every target, one after the other."""
    if sys.argv[1:2] == ["--child"]:
        run_target(sys.argv[2], sys.argv[3:])
        return 0
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=1.0, help="for each parser")
    parser.add_argument("--runs", type=int, help="inputs of each parser, however long it takes")
    names = [*TARGETS, *FIRMWARE]
    parser.add_argument("--target", nargs="*", choices=names, default=names)
    arguments = parser.parse_args()
    ending = f"-max_total_time={round(60 * arguments.minutes)}"
    if arguments.runs is not None:
        ending = f"-runs={arguments.runs}"
    well = [fuzz(name, ending) for name in arguments.target]
    return not all(well)


if __name__ == "__main__":
    sys.exit(main())
