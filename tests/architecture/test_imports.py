"""Imports between rooms: no circles, and only what docs/architecture.md allows."""

import ast
import tomllib
from pathlib import Path

import draw_rooms
import pytest
from rooms import (
    PACKAGE,
    allowed,
    circles,
    circles_of,
    file_of,
    graph,
    imports_between_rooms,
    modules,
)

EXCEPTIONS = tomllib.loads((Path(__file__).parent / "exceptions.toml").read_text())
POSIX = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}


def test_no_module_imports_itself_around_a_circle():
    assert circles() == []


def test_no_room_imports_itself_around_a_circle():
    assert circles_of(imports_between_rooms()) == []


@pytest.mark.parametrize("room", sorted(allowed()))
def test_a_room_imports_what_the_table_allows_and_nothing_else(room):
    # Equal, not only a part of it: a permission that is not needed would mislead.
    assert imports_between_rooms()[room] == allowed()[room]


def test_the_table_names_rooms_that_exist():
    assert set(allowed()) == set(imports_between_rooms())


def test_modules_that_only_posix_has_are_imported_in_the_listed_places_alone():
    found = {}
    for module in modules():
        file = file_of(module)
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            for name in set(names) & POSIX:
                found.setdefault(file.relative_to(PACKAGE).as_posix(), set()).add(name)
    assert {file: sorted(names) for file, names in found.items()} == EXCEPTIONS["posix"]


def test_nothing_but_the_command_line_is_above_the_command_line():
    importers = graph().find_modules_that_directly_import("relpos.cli.main")
    assert not {m for m in importers if not m.startswith("relpos.cli")}


def test_the_picture_shows_the_imports_as_they_are():
    assert draw_rooms.PICTURE.read_text() == draw_rooms.picture(), "run `make docs`"
