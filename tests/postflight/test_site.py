"""The documentation as a site: whole, asking for nothing, and with a search that works from a folder."""

import importlib.util
import re
import subprocess
import sys

import click
import pytest

from postflight.cli import cli
from tests.documents import ROOT

NEEDED = ("material", "mkdocstrings", "latex2mathml", "mkdocs_click", "nbconvert")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        any(importlib.util.find_spec(name) is None for name in NEEDED), reason="the extra 'docs' is not installed"
    ),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("docs") / "site"
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)],
        cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_site_is_whole_and_asks_for_nothing(site):
    pages = {page.relative_to(site).as_posix(): page.read_text() for page in site.rglob("*.html")}
    for name, text in pages.items():
        asked = re.findall(r"<(?:script|img|iframe|source)[^>]* src=\"?(?:https?:)?//", text)
        asked += re.findall(r"<link[^>]* href=\"?(?:https?:)?//[^>]*(?:stylesheet|preconnect|icon)", text)
        assert not asked, f"{name} loads something from elsewhere"
        assert not re.search(r'class="arithmatex"', text), f"{name} has a formula that is not drawn"
    assert "<math" in pages["derivations.html"]
    assert "estimate_misalignment" in pages["interface.html"]
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        assert f"notebooks/{notebook.stem}.html" in pages


def test_every_command_is_on_the_page_of_the_command_line(site):
    page = (site / "command-line.html").read_text()

    def commands(group, way):
        for name, command in group.commands.items():
            yield (*way, name)
            if isinstance(command, click.Group):
                yield from commands(command, (*way, name))

    names = list(commands(cli, ()))
    assert len(names) > 15
    for way in names:
        assert re.search(rf"<code>postflight {' '.join(way)}\b|>{way[-1]}<", page), " ".join(way)


@pytest.mark.browser
def test_search_works_from_a_folder(site, browser):
    page = browser.new_page()
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"file://{site / 'index.html'}")
    page.get_by_placeholder("Search").fill("Southwell")
    found = page.locator(".md-search-result__link")
    found.first.wait_for(timeout=30_000)
    assert any("deflection.html" in (link.get_attribute("href") or "") for link in found.all())
    assert all(url.startswith(("file:", "data:", "blob:", "about:")) for url in asked), asked
    page.close()
