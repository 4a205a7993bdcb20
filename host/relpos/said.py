"""Texts of a session that a page says in its reader's language: English, with a key and values."""

from __future__ import annotations

from collections.abc import Iterable
from string import Formatter
from typing import Any


class Said(str):
    """An English text whose ``key`` and ``values`` let a page find it in another catalogue.

    Wherever no page is involved it is an ordinary string. Catalogues name it ``said.KEY``.
    """

    key: str
    values: dict[str, Any]
    template: str

    def __new__(cls, key: str, template: str, **values: Any) -> Said:
        """Return ``template`` filled with ``values``."""
        made = super().__new__(cls, template.format(**values))
        made.key, made.template = key, template
        # A page rounds as the English text does.
        specs = {name: spec for _, name, spec, _ in Formatter().parse(template) if name and spec}
        made.values = {
            name: float(format(value, specs[name])) if name in specs else value
            for name, value in values.items()
        }
        return made

    def filled(self, **values: Any) -> Said:
        """Return the same text with other values."""
        return Said(self.key, self.template, **{**self.values, **values})


def refusal(text: str) -> dict[str, Any]:
    """Return the answer to a request that is refused, for a page to translate."""
    said = text if isinstance(text, Said) else Said("refused", "refused: {why}", why=text)
    return {"error": str(text), "said": said_of(said)}


def said_of(text: str) -> dict[str, Any] | None:
    """Return the key and the values of a text for a page; None where it has none.

    A value that is such a text itself is translated, too.
    """
    if not isinstance(text, Said):
        return None
    return {"key": text.key, "values": {k: said_of(v) or v for k, v in text.values.items()}}


def joined(texts: Iterable[Said]) -> Said:
    """Return several texts as one."""
    first, *rest = texts
    for text in rest:
        first = Said("also", "{one}; {other}", one=first, other=text)
    return first
