"""A headless Chromium for tests of what runs in a browser: WebGL 2 and WebGPU in software, nothing from the network.

    with browser.launch() as chromium:
        page = chromium.new_page()

Needs Playwright's Python package (not its browsers) and a Chromium or Chrome on the PATH, or at CLOD_CHROMIUM. Where
one is missing the test is skipped with a reason; with CLOD_NEED_BROWSER=1 it fails instead.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SOFTWARE = (
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",  # WebGL
    "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan",  # WebGPU
    "--disable-background-networking",
)  # fmt: skip


def find() -> str:
    """Path of the Chromium that tests are run in; skips where there is none."""
    named = os.environ.get("CLOD_CHROMIUM")
    for name in (named,) if named else NAMES:
        if path := shutil.which(name):
            return path
    missing(f"{named} is not a program" if named else "no Chromium on the PATH: apt-get install chromium")


@contextmanager
def launch(*flags: str) -> Iterator[Any]:
    """A Playwright browser with its own profile, closed at the end; skips where there is none.

    Pages from ``file://`` and loopback are read as a user's browser reads them; ``flags`` are added to Chromium's.
    """
    path = find()
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing("Playwright is not installed: pip install playwright")
    with sync_playwright() as playwright:
        # A test has root in many containers, where Chromium's sandbox refuses to start.
        chromium = playwright.chromium.launch(
            executable_path=path, headless=True, chromium_sandbox=False, args=[*SOFTWARE, *flags]
        )
        try:
            yield chromium
        finally:
            chromium.close()


def missing(what: str) -> NoReturn:
    """Skips the test; fails it if CLOD_NEED_BROWSER is 1."""
    if os.environ.get("CLOD_NEED_BROWSER") == "1":
        pytest.fail(f"{what} (CLOD_NEED_BROWSER=1)")
    pytest.skip(what)
