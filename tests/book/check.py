#!/usr/bin/env python3
"""Checks the links of the book that `mdbook build docs` writes.

    tests/book/check.py target/book

A link within the book must name a page or file of the book, and an anchor there. A link that leaves the book must name
a file of the repository. The exit code is 1 if a link is broken. Needs nothing but the standard library.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

DOCS = Path(__file__).resolve().parent.parent.parent / "docs"
# Pages that mdBook adds: they repeat text, or have links relative to the site.
ADDED = {"404.html", "print.html", "toc.html"}


class Page(HTMLParser):
    """The links and anchors of a page."""

    def __init__(self, path: Path):
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.anchors.add(value or "")
            elif (tag, name) in {("a", "href"), ("img", "src")}:
                self.links.append(value or "")


def find_fault(book: Path, pages: dict[Path, Page], page: Path, link: str) -> str | None:
    """Returns the reason why a link of `page` is broken, if it is."""
    parts = urlsplit(link)
    if parts.scheme or parts.netloc:
        return None
    target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
    if not target.is_relative_to(book):
        # mdBook writes links to pages outside the book as .html.
        source = (DOCS / page.relative_to(book).parent / unquote(parts.path)).resolve()
        exists = source.exists() or source.with_suffix(".md").exists()
        return None if exists else "no such file in the repository"
    if not target.exists():
        return "no such page or file in the book"
    if parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
        return "no such anchor"
    return None


def main() -> int:
    book = Path(sys.argv[1]).resolve()
    pages = {path: Page(path) for path in sorted(book.rglob("*.html")) if path.name not in ADDED}
    link_count = 0
    faults = []
    for path, page in pages.items():
        link_count += len(page.links)
        for link in page.links:
            if cause := find_fault(book, pages, path, link):
                faults.append(f"{path.relative_to(book)}: {link}: {cause}")
    print("\n".join([*faults, f"{len(pages)} pages, {link_count} links, {len(faults)} broken"]))
    return 1 if faults or not link_count else 0


if __name__ == "__main__":
    sys.exit(main())
