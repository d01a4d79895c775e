"""Pages in a real browser, headless Chromium; tests are skipped if it is not installed."""

import io
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any, ClassVar

import pytest
from PIL import Image

DESKTOP, PHONE = (1440, 900), (390, 844)

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)


@dataclass
class Shown:
    """A page with its console's errors and warnings, and its failed requests."""

    page: Any
    problems: list[str] = field(default_factory=list)

    def overflows(self) -> bool:
        return self.page.evaluate("document.documentElement.scrollWidth > window.innerWidth")

    def fits(self, size: tuple[int, int]) -> None:
        self.page.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))
        fits = "() => document.documentElement.scrollWidth <= window.innerWidth"
        self.page.wait_for_function(fits)


@pytest.fixture(scope="module")  # while it is open no other test can run an event loop
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("no Chromium: apt-get install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def open_page(
    browser: Any, url: str, size: tuple[int, int] = DESKTOP, offline: bool = False
) -> Shown:
    """Open an address; `offline`, a page that loads anything from the network fails."""
    width, height = size
    context = browser.new_context(
        viewport={"width": width, "height": height}, has_touch=width < 600, offline=offline
    )
    context.set_default_timeout(20_000)
    context.set_default_navigation_timeout(120_000)  # plotly loads slowly on a shared core
    shown = Shown(context.new_page())
    shown.page.on(
        "console",
        lambda m: shown.problems.append(m.text) if m.type in ("error", "warning") else None,
    )
    shown.page.on("pageerror", lambda error: shown.problems.append(str(error)))
    shown.page.on("requestfailed", lambda r: shown.problems.append(f"failed: {r.url}"))
    shown.page.goto(url)
    shown.page.wait_for_selector("body[data-ready=yes]", timeout=120_000)
    return shown


@pytest.fixture
def show(browser):
    opened = []

    def show(url: str, size: tuple[int, int] = DESKTOP) -> Shown:
        opened.append(open_page(browser, url, size))
        return opened[-1]

    yield show
    for shown in opened:
        shown.page.context.close()


class Tiles(BaseHTTPRequestHandler):
    """A map server that answers every tile with a grey square, and keeps what it was asked."""

    asked: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        self.asked.append(self.path)
        data = io.BytesIO()
        tone = 170 + 50 * (sum(map(int, self.path.removesuffix(".png").split("/")[1:])) % 2)
        Image.new("RGB", (256, 256), (tone, tone + 20, tone)).save(data, "PNG")
        self.send_response(200)
        self.send_header("Content-Type", "image/png")
        self.end_headers()
        self.wfile.write(data.getvalue())

    def log_message(self, *arguments: object) -> None:
        """Keep the tests' output clean."""


@pytest.fixture
def tile_server():
    server = ThreadingHTTPServer(("127.0.0.1", 0), Tiles)
    thread = Thread(target=server.serve_forever)
    thread.start()
    Tiles.asked.clear()
    yield f"http://127.0.0.1:{server.server_port}/{{z}}/{{x}}/{{y}}.png"
    server.shutdown()
    thread.join()
    server.server_close()
