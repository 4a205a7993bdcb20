"""Every command that README and the pages show, and what the tests do with each.

A command of `relpos` is run in a scratch directory, with an emulated team behind the port and
small simulated runs in place of what a reader has; shortened by options where it would take long.
What cannot be run is parsed by the real command line, for a reason that stands in ``PARSED``.
Commands of other programs are known to ``OTHERS`` with a check and the reason why they are not run.
A command in no class fails the test.
"""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import typer
from markdown_it import MarkdownIt
from markdown_it.token import Token

from relpos.cli import main, node_calibrate

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
SHELLS = ("sh", "bash", "shell", "console")

PARSED = {
    "node flash": "wants a board on USB; tests/system/test_flash.py plays one",
    "node check": "a node lies still for a minute; tests/nodes/test_node_check.py checks one",
    "node calibrate": "somebody turns the node or walks; tests/system/test_calibration.py does",
    "mission": "runs until it is stopped; tests/view/test_mission_kill.py stops one",
    "figures": "computes for minutes; tests/evaluation/test_figures.py draws small ones",
}
"""Subcommands that are parsed alone, and why."""

SHORTER = {
    "demo": ("--seconds 10", "--nodes 3"),
    "emulate": ("--seconds 10",),
    "fuse": ("--no-report",),
    "simulate": ("--set seconds=20",),
    "fuse PORT": ("--seconds 2",),
    "node list": ("--seconds 3",),
    "node monitor": ("--seconds 3",),
}
"""Options that make a command short, where it does not give them itself."""

PORTS = re.compile(r"^(PORT|THE_PORT_IT_PRINTS|/dev/tty\w+|/dev/pts/\d+|COM\d+)$")


@dataclass(frozen=True)
class Command:
    """One command as it stands in a page; ``line`` of the block it stands in."""

    page: str
    line: int
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {shlex.join(self.words)}"


@cache
def tokens(page: Path) -> list[Token]:
    """A page as Markdown's parser sees it."""
    return MarkdownIt().enable("table").parse(page.read_text(encoding="utf-8"))


def blocks(page: Path) -> Iterator[Token]:
    """The page's code blocks, fenced and indented, also inside lists and tables."""
    for token in tokens(page):
        if token.type in ("fence", "code_block"):
            yield token


def commands(page: Path) -> Iterator[Command]:
    """Every line of a shell's block, and of others what begins with a program that we know."""
    name = page.relative_to(ROOT).as_posix()
    for block in blocks(page):
        shell = block.info.split(" ")[0] in SHELLS
        text = block.content.replace("\\\n", " ")
        first = (block.map or [0])[0] + 1
        for number, line in enumerate(text.splitlines(), first + (block.type == "fence")):
            bare = line.strip().removeprefix("$ ")
            if not bare or bare.startswith("#"):
                continue
            words = split(bare)
            if shell or program(words) in ("relpos", *OTHERS):
                yield Command(name, number, tuple(words))


def mentions(page: Path) -> Iterator[Command]:
    """Commands of relpos in running text, between backticks: often in part only."""
    name = page.relative_to(ROOT).as_posix()
    for token in tokens(page):
        for child in token.children or ():
            if child.type == "code_inline" and child.content.startswith("relpos "):
                yield Command(name, (token.map or [0])[0] + 1, tuple(split(child.content)))


def split(line: str) -> list[str]:
    """Words as a shell sees them, without a comment behind them."""
    try:
        return shlex.split(line, comments=True)
    except ValueError:  # a quotation mark in an illustration
        return line.split()


def program(words: Sequence[str]) -> str:
    """The program that a command starts, without its folder and without variables before it."""
    rest = [word for word in words if not re.match(r"^[A-Z_]+=", word)] or [""]
    return "tools/pio" if rest[0] == "tools/pio" else rest[0].rsplit("/", 1)[-1]


# -- relpos ----------------------------------------------------------------------------------------


@cache
def _command_line() -> typer.core.click.Command:
    return typer.main.get_command(main.app)


def subcommand(words: Sequence[str]) -> tuple[str, typer.core.click.Command, list[str]]:
    """(name, command, its arguments) of a `relpos` command; AssertionError where there is none."""
    command = _command_line()
    path: list[str] = []
    rest = list(words[1:])
    while rest and hasattr(command, "commands"):
        if rest[0].startswith("-"):
            break
        if rest[0] not in command.commands and isinstance(command, node_calibrate.CalibrateGroup):
            rest.insert(0, node_calibrate.DEFAULT)
        assert rest[0] in command.commands, f"there is no command {' '.join([*path, rest[0]])}"
        command = command.commands[rest[0]]
        path.append(rest.pop(0))
    return " ".join(path), command, rest


def options(command: typer.core.click.Command) -> set[str]:
    """Every option's names."""
    return {name for p in command.params for name in (*p.opts, *p.secondary_opts)} | {"--help"}


def unknown_options(words: Sequence[str]) -> list[str]:
    """Options that the real command line does not have."""
    _, command, rest = subcommand(words)
    given = [word.split("=")[0].rstrip(",.)") for word in rest if word.startswith("--")]
    return [word for word in given if word != "--" and word not in options(command)]


def why_only_parsed(words: Sequence[str]) -> str | None:
    """Why a command of relpos is not run; None where it is."""
    name, _, rest = subcommand(words)
    if "--help" in rest or name.startswith("emulate"):
        return None
    return next((why for known, why in PARSED.items() if name.startswith(known)), None)


def shortened(words: Sequence[str]) -> list[str]:
    """The command with the options that make it short."""
    name, _, rest = subcommand(words)
    if name == "fuse" and any(map(PORTS.match, rest)):
        name = "fuse PORT"
    given = list(words)
    if "--help" not in rest:
        for option in SHORTER.get(name, ()):
            if option.split()[0] not in rest:
                given += option.split()
    return given


# -- other programs --------------------------------------------------------------------------------


def _rule_exists(words: Sequence[str]) -> bool:
    rules = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for word in words[1:]:
        name, equals, value = word.partition("=")
        if name == "LIVE":
            assert not unknown_options(["relpos", "demo", *split(value)]), word
        elif not equals and name not in rules:
            return False
    return True


def _script_knows_its_options(words: Sequence[str]) -> bool:
    """A script of the repository is there and names every option that is given."""
    if words[1:2] == ["-c"] or words[1:3] == ["-m", "pip"]:
        return True
    if words[1] == "-m":
        path = ROOT / "host" / Path(*words[2].split(".")).with_suffix(".py")
        if words[2] == "venv":
            return True
    else:
        path = ROOT / words[1]
    text = path.read_text(encoding="utf-8")
    return all(f'"{word}"' in text for word in words[2:] if word.startswith("--"))


def _environment_exists(words: Sequence[str]) -> bool:
    project = (ROOT / "platformio.ini").read_text()
    named = [words[k + 1] for k, word in enumerate(words) if word == "-e"]
    return all(f"[env:{name}]" in project for name in named)


def _extras_exist(words: Sequence[str]) -> bool:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = re.findall(r"\[([\w,]+)\]", " ".join(words))
    return {e for group in named for e in group.split(",")} <= {*project["optional-dependencies"]}


def _nothing_to_check(_: Sequence[str]) -> bool:
    return True


OTHERS: dict[str, tuple[str, Callable[[Sequence[str]], bool]]] = {
    "make": ("minutes, and what CI runs: the rule has to exist", _rule_exists),
    "python": ("a measurement of minutes: script and options have to exist",
               _script_knows_its_options),
    "python3": ("see python", _script_knows_its_options),
    "pio": ("the toolchain's minutes: the environment has to exist", _environment_exists),
    "tools/pio": ("see pio", _environment_exists),
    "pip": ("downloads; tests/packaging/test_online_installs.py does it (soak)", _extras_exist),
    "pipx": ("see pip", _extras_exist),
    "uv": ("see pip", _extras_exist),
    "export": ("the shell's own", _nothing_to_check),
    "cd": ("the shell's own", _nothing_to_check),
    "evo_ape": ("another's program; tests/exchange/test_convert.py calls it", _nothing_to_check),
    "git": ("another's program, from the net", _nothing_to_check),
    "sudo": ("changes the computer", _nothing_to_check),
    "xdg-open": ("opens a window", _nothing_to_check),
}  # fmt: skip
"""Program: why it is not run, and what is checked instead."""
