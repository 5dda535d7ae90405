"""The documentation site: navigation, a strict build, and its pages on a phone.

The build needs the environment of ``make docs``; the browser test also Chromium and Playwright.
"""

from __future__ import annotations

import html
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
GENERATED = {"index.md", "changelog.md", "api/"}  # by website/pages.py
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
PHONE = {"width": 390, "height": 844}
PATIENCE = 120.0  # seconds, for a busy machine
# Unrendered lists, roles and directives of reStructuredText, links of Markdown.
LEFT_OVER = re.compile(r"^\s*[-*] |`|\]\(|:(class|func|meth|mod|attr|math):|\.\. \w+::|::$")


class Settings(yaml.SafeLoader):
    """Loads mkdocs.yml without importing what its Python tags name."""


Settings.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: suffix)


def navigation() -> list[str]:
    def files(entry):
        if isinstance(entry, str):
            return [entry]
        children = entry.values() if isinstance(entry, dict) else entry
        return [file for child in children for file in files(child)]

    settings = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Settings)
    return files(settings["nav"])


def test_navigation_lists_every_page_once():
    written = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert sorted(navigation()) == sorted(written | GENERATED)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    python = ROOT / ".venv-docs" / "bin" / "python"
    if not python.exists():
        if not (importlib.util.find_spec("mkdocs") and importlib.util.find_spec("mkdocstrings")):
            pytest.skip("the site needs MkDocs in its own environment: make docs")
        python = Path(sys.executable)
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [python, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    return folder


@pytest.mark.slow
def test_site_builds_strictly_with_api_links_and_gallery(site):
    overview = (site / "api" / "index.html").read_text(encoding="utf-8")
    transforms = (site / "api" / "transforms" / "index.html").read_text(encoding="utf-8")
    assert "transforms/#torchrl_etl.transforms.SynergyAction" in overview
    assert 'id="torchrl_etl.transforms.SynergyAction"' in transforms
    compose = (site / "compose" / "index.html").read_text(encoding="utf-8")
    assert "transforms/#torchrl_etl.transforms.SynergyAction" in compose
    assert 'class="admonition deviates"' in transforms
    tasks = (site / "tasks" / "index.html").read_text(encoding="utf-8")
    assert '<div class="grid cards gallery">' in tasks
    assert tasks.count('<img loading="lazy"') == tasks.count("<img ") == tasks.count(".webp")


@pytest.mark.slow
def test_prose_has_no_unrendered_markup(site):
    left = []
    for page in site.rglob("index.html"):
        if page.relative_to(site).parts[0] == "source":
            continue
        prose = re.sub(
            r"<(pre|code|script|style)\b.*?</\1>", "", page.read_text("utf-8"), flags=re.S
        )
        for line in html.unescape(re.sub(r"<[^>]+>", "", prose)).splitlines():
            if LEFT_OVER.search(line):
                left.append((page.relative_to(site).parent.as_posix(), line.strip()[:80]))
    assert left == []


@pytest.fixture(scope="module")
def address(site) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=site))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()


@pytest.mark.slow
def test_every_page_fits_a_phone_without_errors_or_external_requests(request):
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="the browser test needs Playwright: pip install playwright"
    )
    if CHROMIUM is None:
        pytest.skip("the browser test needs Chromium: apt-get install chromium")
    site, address = request.getfixturevalue("site"), request.getfixturevalue("address")
    index = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))
    pages = [page.parent.relative_to(site).as_posix() for page in sorted(site.rglob("index.html"))]
    faults, wide = [], []

    def refuse(route):
        faults.append(route.request.url)
        route.abort()

    with playwright.sync_playwright() as engines:
        chromium = engines.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        tab = chromium.new_page(viewport=PHONE)
        tab.set_default_timeout(1000 * PATIENCE)
        tab.route(lambda url: not url.startswith(address), refuse)
        tab.on("pageerror", lambda error: faults.append(str(error)))
        tab.on("console", lambda said: faults.append(said.text) if said.type == "error" else None)
        for page in pages:
            tab.goto(f"{address}{page}/")
            width = tab.evaluate("document.documentElement.scrollWidth")
            if width > PHONE["width"]:
                wide.append((page, width))
            if page == pages[0]:  # every page indexes the whole site for its search: once is enough
                tab.route("**/search_index.json", lambda r: r.fulfill(json={**index, "docs": []}))
        chromium.close()
    assert (faults, wide) == ([], [])
    assert len(pages) > len(navigation())
