"""Checks a built site: links and anchors resolve, nothing is loaded from elsewhere, every public name is there.

python docs/check_site.py build/site [tests/api_surface.txt]
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlsplit

LOADING = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "video": "src", "use": "href"}
FETCHED = {"stylesheet", "icon", "preload", "preconnect", "prefetch", "dns-prefetch", "modulepreload"}


class Page(HTMLParser):
    """Anchors, links and loaded files of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        address = values.get(LOADING.get(tag, ""), "")
        if address and (tag != "link" or FETCHED & set(values.get("rel", "").split())):
            self.loaded.append(address)


def remote(address: str) -> bool:
    return bool(urlsplit(address).netloc)


def problems(site: Path, names: list[str] | None = None) -> list[str]:
    """What is wrong with a site.

    Args:
        site: folder with the built pages.
        names: dotted names that must be an anchor somewhere.

    Returns:
        One line per problem.
    """
    pages = {path: Page(path.read_text()) for path in sorted(site.rglob("*.html"))}
    found = [] if pages else [f"no page in {site}"]
    for path, page in pages.items():
        place = path.relative_to(site)
        for address in page.loaded:
            if remote(address):
                found.append(f"{place}: loads {address}")
        # 404.html is shown at any address, so that its links are absolute.
        for address in [] if path.name == "404.html" else page.links + page.loaded:
            if remote(address) or address.startswith(("mailto:", "data:", "javascript:")):
                continue
            file, anchor = urldefrag(address)
            target = path if not file else (path.parent / unquote(urlsplit(file).path)).resolve()
            if target.is_dir():
                target /= "index.html"
            if not target.exists():
                found.append(f"{place}: no file for {address}")
            elif anchor and target.suffix == ".html" and unquote(anchor) not in pages[target].anchors:
                found.append(f"{place}: no anchor for {address}")
    for style in sorted(site.rglob("*.css")):
        found += [f"{style.relative_to(site)}: loads {u}" for u in re.findall(r"url\(['\"]?((?:https?:)?//[^)'\"]+)", style.read_text())]
    anchors = set().union(*(page.anchors for page in pages.values())) if pages else set()
    return found + [f"no anchor for the public name {name}" for name in names or [] if name not in anchors]


def main(arguments: list[str]) -> int:
    site = Path(arguments[0]).resolve()
    names = [".".join(line.split()) for line in Path(arguments[1]).read_text().splitlines()] if len(arguments) > 1 else None
    found = problems(site, names)
    print("\n".join(found) or f"{len(list(site.rglob('*.html')))} pages: links, anchors and names are there")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
