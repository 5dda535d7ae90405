"""The viewer's page in a browser: loading, sliders, play and pause.

Needs Chromium (Debian: ``apt-get install chromium``) and Playwright for Python (``pip install
playwright``); Playwright downloads no browser.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import torch

from torchrl_etl.analysis.viewer import Session, Subject
from torchrl_etl.analysis.viewer.page import Page
from torchrl_etl.envs import EnvironmentSpec, make_env, resolve_task
from torchrl_etl.modules import SynergyDecoder

playwright = pytest.importorskip(
    "playwright.sync_api", reason="the browser test needs Playwright: pip install playwright"
)
NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None, reason="the browser test needs Chromium: apt-get install chromium"
    ),
]
TASK = "myoElbowPose1D6MFixed-v0"  # six muscles: light enough to be drawn without a GPU
PATIENCE = 60.0  # seconds, for a busy machine


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    spec = EnvironmentSpec.of(make_env(TASK))
    directions = torch.zeros(2, spec.action_dim)
    directions[0, 0] = directions[1, 1] = 0.9
    decoder = SynergyDecoder.from_directions(
        torch.zeros(spec.action_dim), directions, low=spec.low.tolist(), high=spec.high.tolist()
    )
    task, stop = resolve_task(TASK), threading.Event()
    subject = Subject("test", task, lambda goal: make_env(TASK), spec.actuators, decoder=decoder)
    page = Page(Session(subject), port=0)
    thread = threading.Thread(target=page.run, args=(stop.is_set,))
    thread.start()
    yield page
    stop.set()
    thread.join()


@pytest.fixture(scope="module")
def browser(page) -> Iterator[tuple]:
    """The page in Chromium, and the errors of its console."""
    faults: list[str] = []
    with playwright.sync_playwright() as engines:
        chromium = engines.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        tab = chromium.new_page(viewport={"width": 820, "height": 240})
        tab.set_default_timeout(1000 * PATIENCE)
        tab.on("pageerror", lambda error: faults.append(str(error)))
        tab.on(
            "console",
            lambda said: faults.append(said.text) if said.type == "error" else None,
        )
        tab.goto(page.address)
        yield tab, faults
        chromium.close()


def wait(until: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + PATIENCE
    while not until() and time.monotonic() < deadline:
        time.sleep(0.05)
    return until()


def press(tab, name: str, until: Callable[[], bool]) -> bool:
    """Click, and once more if nothing happens: viser 1.1 can lose a click."""
    for _ in range(2):
        tab.get_by_role("button", name=name).dispatch_event("click")
        if wait(until):
            return True
    return False


def test_page_loads_and_lists_the_muscles(browser, page):
    tab, faults = browser
    tab.get_by_text("Synergies").first.wait_for()
    tab.get_by_text(page.session.subject.actuators[0]).first.wait_for()
    assert tab.get_by_role("slider").count() == 2
    assert faults == []


def test_slider_moves_its_muscle(browser, page):
    tab, faults = browser
    before = page.session.data.act.copy()
    tab.get_by_role("slider").first.press("End")
    assert wait(lambda: page.session.data.act[0] > before[0] + 0.3)
    assert page.session.coefficients.tolist() == [1.0, 0.0]
    assert page.session.driver == "sliders"
    assert faults == []


def test_play_advances_the_episode_until_pause(browser, page):
    tab, faults = browser
    steps = page.session.steps
    assert press(tab, "Play", lambda: page.session.steps > steps + 10)
    assert press(tab, "Pause", lambda: not page.session.playing)
    assert press(tab, "Reset", lambda: page.session.steps == 0)
    assert faults == []


def test_closing_the_browser_pauses_the_session(browser, page):
    tab, _ = browser
    page.session.playing = True
    tab.close()
    assert wait(lambda: not page.session.playing)
    assert page.server.get_clients() == {}
