# SPDX-License-Identifier: Apache-2.0
"""The documentation builds as a site without a warning; its links lead somewhere and nothing comes from the network."""

import inspect
import os
import pydoc
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from needs import reason

from warpmpc import __all__ as public
from warpmpc.cost.terms import TERMS

pytest.importorskip("mkdocs_autorefs", reason=reason("mkdocs_autorefs"))
ROOT = Path(__file__).parents[2]
LOADED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src"}
"""Attributes of elements whose targets a browser fetches by itself."""


class Page(HTMLParser):
    """Links, fetched files and anchors of a page."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = {name: value for name, value in attrs if value}
        self.anchors |= {known[name] for name in ("id", "name") if name in known}
        if tag in LOADED and LOADED[tag] in known and known.get("rel") not in ("canonical", "prev", "next"):
            self.fetched.append(known[LOADED[tag]])
        elif tag == "a" and "href" in known:
            self.links.append(known["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return {path: Page(path.read_text(encoding="utf-8")) for path in folder.rglob("*.html")}


def test_every_link_leads_to_a_page_and_a_place_that_exist(site):
    broken = []
    for path, page in site.items():
        if path.name == "404.html":  # its links begin at the root of a server
            continue
        for link in (*page.links, *page.fetched):
            address = urlsplit(link)
            if address.scheme or address.netloc:
                continue
            target = (path.parent / unquote(address.path)).resolve() if address.path else path
            target = target / "index.html" if target.is_dir() else target
            place = unquote(address.fragment)
            if not target.is_file() or (place and target in site and place not in site[target].anchors):
                broken.append((path.name, link))
    assert broken == []


def test_a_browser_fetches_nothing_from_the_network(site):
    fetched = {link for page in site.values() for link in page.fetched}
    assert fetched
    assert [link for link in fetched if urlsplit(link).scheme not in ("", "data") or urlsplit(link).netloc] == []


def test_every_public_name_and_every_term_has_its_place(site):
    anchors = {path.name: page.anchors for path, page in site.items() if path.parent.name == "reference"}
    assert {f"warpmpc.{name}" for name in public} - anchors["python.html"] == set()
    assert TERMS.keys() - anchors["terms.html"] == set()
    assert {"robot-drive", "planner-noise", "success-conditions"} <= anchors["scene.html"]
    assert {"run", "check", "new", "schema"} <= anchors["commands.html"]


def test_the_list_of_names_has_the_first_sentences_of_docstrings(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools" / "pages")
    from roles import plain

    def sentence(name: str) -> str:
        value = pydoc.locate(name)
        text = inspect.getdoc(getattr(value, "func", value)).split("\n\n")[0]
        return " ".join(plain(text).replace("``", "`").split())

    text = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    names = re.findall(r"^\* `(.+?)`: (.*)$", text, flags=re.MULTILINE)
    assert names == [(name, sentence(name)) for name, _ in names]
