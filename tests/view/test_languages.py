"""The pages in other languages: every message in every catalogue, no text outside of them."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from stage import Stage
from walking_team import WalkingTeam

from relpos.live.team_view import Level, Notice
from relpos.said import Said

ROOT = Path(__file__).parents[2]
STATIC = ROOT / "host" / "relpos" / "view" / "static"
LANGUAGES = ("en", "de", "fr", "es")
Message = str | dict[str, str]

READ_TEXTS = """() => {
  const found = [];
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const { parentElement, data } = walk.currentNode;
    if (!parentElement.closest("noscript, script, #language")) found.push(data);
  }
  const names = ["aria-label", "title", "placeholder", "alt", "aria-roledescription"];
  for (const name of [...names, "aria-valuetext"]) {
    for (const element of document.querySelectorAll(`[${name}]`)) {
      found.push(element.getAttribute(name));
    }
  }
  return [...found, document.title];
}"""
NOT_LANGUAGE = re.compile(
    r"relpos|Drill at the old mill|Gustav Adolf|Anna|Ben|Chloé|Dmitri|Emil|Fatima|Knot"
    r"|https?://\S+|\b(?:m|cm|s|ms|min|h|V|dBm|bar|x|y)\b|\b\d+\b"
)


def catalogue(language: str) -> dict[str, Message]:
    found: dict[str, Message] = json.loads(
        (STATIC / "lang" / f"{language}.json").read_text("utf-8")
    )
    return found


def forms(message: Message) -> list[str]:
    return [message] if isinstance(message, str) else list(message.values())


def holes(message: Message) -> set[str]:
    return {name for form in forms(message) for name in re.findall(r"\{(\w+)\}", form)}


@pytest.mark.parametrize("language", LANGUAGES[1:])
def test_every_message_is_in_every_language_with_the_same_values(language: str) -> None:
    english, other = catalogue("en"), catalogue(language)
    assert other.keys() == english.keys()
    for key, message in english.items():
        assert holes(other[key]) == holes(message), key
        assert type(other[key]) is type(message), key
        assert all(form.strip() for form in forms(other[key])), key


def test_every_key_of_the_pages_is_in_the_catalogue_and_every_message_is_used() -> None:
    english = catalogue("en")
    sources = [*STATIC.rglob("*.js"), *STATIC.rglob("*.html")]
    text = "\n".join(path.read_text("utf-8") for path in sources)
    plain = set(re.findall(r'data-t(?:-\w+)?(?:="|": ")([\w.-]+)"', text))
    plain -= {"aria-label", "placeholder", "alt", "aria-roledescription", "title"}
    plain |= set(re.findall(r'\bt\("([^"]+)"', text))
    for yes, no in re.findall(
        r'\bt\([^()"`]*(?:\([^()]*\))?[^()"`]*\? "([^"]+)" : "([^"]+)"', text
    ):
        plain |= {yes, no}
    assert plain - english.keys() == set()
    # Keys that are put together: `side.${...}` stands for all that begin and end alike.
    built = [
        re.compile(re.sub(r"\\\$\\\{.*?\\\}", ".+", re.escape(template)))
        for template in re.findall(r"(?:\bt\(|data-t\": |has\()`([^`]+)`", text)
    ]
    quoted = set(re.findall(r'"([\w.-]+)"', text))
    unused = [
        key
        for key in english.keys() - plain - quoted
        if not key.startswith("said.") and not any(pattern.fullmatch(key) for pattern in built)
    ]
    assert unused == []


def test_the_session_says_in_english_what_the_english_catalogue_says() -> None:
    english = catalogue("en")
    said: dict[str, str] = {}
    for path in (ROOT / "host" / "relpos").rglob("*.py"):
        text = path.read_text("utf-8")
        if "Said(" not in text:
            continue
        constants = {
            target.id: node.value.value
            for node in ast.walk(ast.parse(text))
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Said":
                key, template = node.args[0], node.args[1]
                if not isinstance(key, ast.Constant):
                    continue  # A copy of another one.
                value = (
                    template.value
                    if isinstance(template, ast.Constant)
                    else constants[ast.unparse(template)]
                )
                said[f"said.{key.value}"] = re.sub(r"\{(\w+):[^}]*\}", r"{\1}", str(value))
    assert said == {key: text for key, text in english.items() if key.startswith("said.")}


def untranslated(path: Path) -> list[str]:
    """Texts of a file that reach a page without a key: line and text."""
    found = []

    def look(node: ast.AST | None) -> None:
        """Report what is written out in an expression, except within ``Said`` and its like."""
        if node is None:
            return
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name in ("Said", "filled", "of_node", "joined", "words_of", "getattr"):
                return
        if isinstance(node, ast.Compare | ast.Subscript):
            return
        text = "".join(
            part.value
            for part in (node.values if isinstance(node, ast.JoinedStr) else [node])
            if isinstance(part, ast.Constant) and isinstance(part.value, str)
        )
        if re.search(r"[a-z]{2}", text):
            found.append(f"{path.name}:{node.lineno}: {text}")  # type: ignore[attr-defined]
            return
        for child in ast.iter_child_nodes(node):
            look(child)

    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            called, of = node.func.attr, ast.unparse(node.func.value)
            if called == "append" and of.endswith("remarks"):
                look(node.args[0])
            elif called == "post" and of == "self" and len(node.args) == 3:
                look(node.args[2])
            elif called == "log" and of == "self" and path.parent.name == "live":
                look(node.args[1])
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).endswith("trouble"):
            look(node.value)
        elif isinstance(node, ast.FunctionDef) and node.name in ("trouble", "waits_for"):
            for inner in ast.walk(node):
                if isinstance(inner, ast.Return):
                    look(inner.value)
    return found


def test_no_text_of_the_session_reaches_a_page_without_a_key() -> None:
    sources = ROOT / "host" / "relpos"
    rooms = [path for room in ("live", "link", "view") for path in (sources / room).rglob("*.py")]
    recording = [sources / "recording" / f"{name}.py" for name in ("recorder", "viewer", "player")]
    assert [text for path in (*rooms, *recording) for text in untranslated(path)] == []


def test_a_text_without_a_key_would_be_found(tmp_path: Path) -> None:
    path = tmp_path / "live" / "x.py"
    path.parent.mkdir()
    path.write_text('self._trouble = f"{file}: no room"\nself.post("x", 1, "it is late")\n')
    assert [found.partition(": ")[2] for found in untranslated(path)] == [": no room", "it is late"]


def test_a_text_of_the_session_is_a_string_with_a_key() -> None:
    text = Said("supply", "supply {volts:.2f} V", volts=4.3449)
    assert text == "supply 4.34 V"
    assert (text.key, text.values) == ("supply", {"volts": 4.34})
    assert Said("moves", "{name} moves again", name="").filled(name="Ben") == "Ben moves again"


def troubled() -> WalkingTeam:
    """A team with everything that a page has words for."""
    team = WalkingTeam(
        lost_since={2: -20.0}, still_since={3: -10.0, 4: 15.0, 6: 30.0}, ambiguous=5, ring=1
    )
    team.health[3] = ("yellow", (Said("supply", "supply {volts:.2f} V", volts=4.3),))
    team.notices = (
        Notice(
            "behind",
            Level.WARNING,
            Said("over", "end of the recording: this is the last picture"),
            1.0,
        ),
    )
    return team


def foreign(messages: dict[str, Message]) -> dict[str, Message]:
    """A language in which every message stands between brackets."""
    return {
        key: f"⟦{message}⟧"
        if isinstance(message, str)
        else {form: f"⟦{text}⟧" for form, text in message.items()}
        for key, message in messages.items()
    }


def stray(page: Page) -> list[str]:
    """Words on the page that stand outside of all brackets."""
    found = []
    for text in page.evaluate(READ_TEXTS):
        left = text
        while (inner := re.sub(r"⟦[^⟦⟧]*⟧", "", left)) != left:
            left = inner
        if re.search(r"[^\W\d_]{2,}", NOT_LANGUAGE.sub("", left)):
            found.append(text)
    return found


@pytest.mark.parametrize("path", ["/", "/phone"])
def test_no_text_of_a_page_is_outside_of_the_catalogues(
    visit: Any, browser: Any, theatre: Stage, path: str
) -> None:
    theatre.reset(troubled())
    context = browser.new_context(locale="de-DE", viewport={"width": 1200, "height": 760})
    try:
        context.route(
            "**/static/lang/de.json", lambda route: route.fulfill(json=foreign(catalogue("en")))
        )
        page = visit(path, context=context, expect_gone=True)
        expect(page.locator("html")).to_have_attribute("lang", "de")
        expect(page.locator("#alarms .alarm").first).to_contain_text("⟦")
        if path == "/":
            page.locator("#as-table").click()
            page.locator(".person .name").first.click()
            for opener in ("show-board", "show-log", "help", "phones"):
                page.locator(f"#{opener}").evaluate("button => button.click()")
            expect(page.locator("#board-rows tr")).to_have_count(6)
            expect(page.locator("#notices")).to_contain_text("⟦end of the recording")
            expect(page.locator("#people")).to_contain_text("⟦supply 4,3 V⟧")
            expect(page.locator("#qr-trouble, #qr").first).to_be_attached()
            page.locator(
                ".person[data-node='3'] .find, .person[data-node='3'] > button"
            ).last.evaluate("button => button.click()")
        else:
            page.get_by_role("button", name="Ben", exact=True).click()
            page.locator("#name-form button").click()
            expect(page.locator("#press")).to_be_visible()
            page.locator("nav button[data-page='team']").click()
            page.locator(".other button").first.click()
            expect(page.locator("#find")).to_be_visible()
        assert stray(page) == []
    finally:
        context.close()


def test_the_page_speaks_the_browsers_language_until_another_is_chosen(
    visit: Any, browser: Any, theatre: Stage
) -> None:
    theatre.reset(troubled())
    context = browser.new_context(locale="de-DE", viewport={"width": 1366, "height": 768})
    try:
        # The page is loaded again below: what it was asking for then may be cut off.
        page = visit("/", context=context, expect_gone=True)
        expect(page.locator("#alarms")).to_contain_text("hat sich")
        expect(page.locator("#alarms")).to_contain_text("Quittieren")
        # A refusal of the server, too.
        page.locator("#layers summary").click()
        page.locator("#plan-file").set_input_files(
            {"name": "plan.png", "mimeType": "image/png", "buffer": b"no image"}
        )
        expect(page.locator("#notices")).to_contain_text("weder PNG noch JPEG noch WebP")
        page.locator("#layers summary").click()
        # A decimal comma, in the table of positions.
        page.locator("#as-table").click()
        expect(page.locator("#table")).to_contain_text(re.compile(r"\d,\d"))
        page.locator("#help").click()
        page.locator("#language").select_option("fr")
        page.keyboard.press("Escape")
        expect(page.locator("#alarms")).to_contain_text("ne bouge plus depuis")
        expect(page.locator("#show-log")).to_contain_text("Journal")
        page.reload()
        expect(page.locator("html")).to_have_attribute("lang", "fr")
        expect(page.locator("#alarms")).to_contain_text("ne bouge plus depuis")
        page.locator("#help").click()
        page.locator("#language").select_option("en")
        expect(page.locator("#alarms")).to_contain_text("has not moved for")
    finally:
        context.close()


def test_a_browser_of_another_language_reads_english(visit: Any, stage: Stage) -> None:
    page = visit("/", locale="ja-JP")
    expect(page.locator("#help")).to_have_text("Help")
