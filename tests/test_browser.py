"""A real browser on the real viewer: a slider is moved, abstract_gap is picked, and the picture shows it."""

from __future__ import annotations

import io
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, chromium
from nerfstudio_runs import Server, free_port, needs_nerfstudio
from PIL import Image
from waiting import until

from ns_abstract.demo.writing import write_demo
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.viewer.views import SplatSource

pytestmark = [
    needs_nerfstudio,
    pytest.mark.skipif(chromium() is None, reason="no Chromium (Debian: apt-get install chromium)"),
]
#: First colour of the viewer's colour map for one channel.
TURBO_ZERO = (48, 18, 59)
_FIGURES = re.compile(r"Abstract images \((\d+) x (\d+).*?MPG ([\d.e-]+), XPG ([\d.e-]+)", re.DOTALL)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """ns-abstract-viewer on the demo scene."""
    folder = tmp_path_factory.mktemp("browser")
    config, _ = write_demo(folder)
    # a picture that is waited for must not wait for compilers beside the browser
    scene = load_scene(config)
    SplatSource(activate(scene, GSPLAT_1_4_0), scene).warm_up()
    command = [sys.executable, "-m", "ns_abstract.cli.viewer", "--load-config", config]
    with Server(command, free_port(), folder, folder) as one:
        assert one.url
        yield one


def figures(text: str) -> tuple[float, float] | None:
    """MPG and XPG that the panel states."""
    found = _FIGURES.search(text)
    return (float(found[3]), float(found[4])) if found else None


def settled(browser: Browser, server: Server, before: tuple[float, float] | None = None) -> tuple[float, float]:
    """The figures once the work on the view has ended; other ones than ``before``."""

    def ended() -> tuple[float, float] | None:
        text = browser.text()
        found = figures(text) if re.search(r"-sound; done", text) else None
        return found if found != before else None

    return until(ended, "the end of the refinement", lambda: server.process.poll() is None)


def seen(browser: Browser, file: Path) -> np.ndarray:
    """The middle of the viewport, [h, w, 3] from 0 to 255."""
    browser.screenshot(file)
    picture = np.asarray(Image.open(io.BytesIO(file.read_bytes())).convert("RGB"), np.int64)
    return picture[120:600, 200:800]


def changed(browser: Browser, file: Path, before: np.ndarray) -> np.ndarray:
    """The viewport once it no longer looks as ``before``."""

    def other() -> tuple[np.ndarray] | None:
        now = seen(browser, file)
        return (now,) if np.abs(now - before).mean() > 10.0 else None

    return until(other, "another picture")[0]


def number_field(label: str) -> str:
    """The number beside a slider, as a JavaScript expression."""
    return (
        f"(() => {{ const l = [...document.querySelectorAll('label')].find(e => e.innerText.trim() === '{label}');"
        " let p = l; while (p && !p.querySelector('input[type=text]')) p = p.parentElement;"
        " return p && p.querySelector('input[type=text]'); })()"
    )


def slider(label: str) -> str:
    """A slider's handle, as a JavaScript expression."""
    return (
        f"(() => {{ const l = [...document.querySelectorAll('label')].find(e => e.innerText.trim() === '{label}');"
        " let p = l; while (p && !p.querySelector('[role=slider]')) p = p.parentElement;"
        " return p && p.querySelector('[role=slider]'); })()"
    )


@pytest.mark.slow
def test_slider_to_picture(server: Server, tmp_path: Path) -> None:
    with Browser(server.url, tmp_path / "profile") as browser:
        until(lambda: "send to certify" in browser.text(), "the panel")
        # away from the scene, which the viewer's first camera stands in
        for _ in range(10):
            browser.call("Input.dispatchMouseEvent", type="mouseWheel", x=400, y=400, deltaX=0, deltaY=240)
            time.sleep(0.1)
        first = settled(browser, server)
        picture = seen(browser, tmp_path / "rgb.png")
        assert picture.std() > 5.0, "nothing is drawn"

        # the slider by its keys: the set shrinks from 10 to 5 thousandths
        x, y = browser.place(slider("± x (0.001 units)"))
        browser.click(x, y)
        browser.ask(f"{slider('± x (0.001 units)')}.focus()")
        before = float(browser.ask(f"{number_field('± x (0.001 units)')}.value"))
        browser.key("ArrowLeft", 37, 50)
        until(lambda: float(browser.ask(f"{number_field('± x (0.001 units)')}.value")) < before - 3.0, "the slider")
        second = settled(browser, server, first)
        assert second[0] < first[0]

        # the output type by hand
        browser.click(*browser.place("document.querySelector('input[value=rgb]')"))
        option = "[...document.querySelectorAll('[role=option]')].find(e => e.innerText === 'abstract_gap')"
        until(lambda: browser.ask(f"!!{option}"), "the list of outputs")
        listed = browser.ask("[...document.querySelectorAll('[role=option]')].map(e => e.innerText).join(' ')")
        assert "abstract_lower abstract_upper abstract_gap abstract_witness" in listed
        browser.click(*browser.place(option))
        gap = changed(browser, tmp_path / "gap.png", picture)
        # the colour map turbo: sky and grass hardly change, edges do
        still = np.abs(gap - TURBO_ZERO).max(axis=-1) < 30
        assert still.mean() > 0.3 and (gap[..., 1] > 150).mean() > 0.005
        assert (np.abs(picture - TURBO_ZERO).max(axis=-1) < 30).mean() < 0.05

        # a part of the scene, by its button
        fields = "[...document.querySelectorAll('input')].map(e => e.value).join('; ')"
        assert "box" not in browser.ask(fields)
        button = "[...document.querySelectorAll('button')].find(e => e.innerText === 'select what is in the middle')"
        browser.click(*browser.place(button))
        until(lambda: '{"box": [[' in browser.ask(fields), "the selection")
        assert "Traceback" not in server.said()
    # the viewer outlives its client
    assert server.url
