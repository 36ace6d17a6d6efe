"""Pages from templates: one base, one style sheet, light and dark, for desk and phone; whatever is put in is escaped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined


@dataclass(frozen=True)
class Badge:
    """A verdict as a mark."""

    kind: str  # "good", "fair", "bad" or "none"
    mark: str
    text: str


@dataclass(frozen=True)
class Cell:
    """A cell of a table that is more than a text."""

    text: str = ""
    look: str = ""  # name of a tag such as "b" or "code"
    badge: Badge | None = None
    below: str = ""  # on a line of its own


@dataclass(frozen=True)
class Table:
    """Rows of as many cells as there are columns; on a phone each row is a card."""

    head: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    kind: str = "plain"


@dataclass(frozen=True)
class Picture:
    """A picture or a film, held by its address."""

    uri: str
    alt: str
    caption: str = ""
    name: str = ""
    poster: str = ""  # what is shown before a film begins

    @property
    def film(self) -> bool:
        """Whether it moves."""
        return self.uri.startswith("data:video/")


@cache
def _templates() -> Environment:
    found = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    found.globals["strict_zip"] = partial(zip, strict=True)
    return found


def render(template: str, **values: Any) -> str:
    """A template filled with values; texts are escaped, a value that is missing is an error. Source: none.

    Example:
        >>> render("certificate.html", level="0", agent="<b>", weights="ab", layers=[]).splitlines()[1][:63]
        '<p>It is about the set {B &le; 0} of the agent <b>&lt;b&gt;</b>'
    """
    return _templates().get_template(template).render(**values)


__all__ = ["Badge", "Cell", "Picture", "Table", "render"]
