"""Headless Chromium for the tests and benchmarks of pages."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

EXECUTABLE = os.environ.get("CHROMIUM", "/usr/bin/chromium")

ARGUMENTS = (
    *("--no-sandbox", "--no-first-run", "--disable-quic", "--disable-sync", "--disable-background-networking"),
    *("--disable-component-update", "--disable-gpu", "--enable-unsafe-swiftshader"),
)
"""Arguments of every start: no network traffic of the browser itself, and WebGL by software."""


@contextmanager
def start_chromium(*arguments: str) -> Iterator[Any]:
    """Run Chromium while the block runs. A test is skipped if Chromium or Playwright is not installed.

    If the environment variable `CHROMIUM` contains its path, as in `make browser`, the test is not skipped.

    Args:
        arguments: Further arguments of the command line.

    Yields:
        The browser as an object of Playwright.
    """
    if "CHROMIUM" not in os.environ and shutil.which(EXECUTABLE) is None:
        pytest.skip(f"needs {EXECUTABLE} (apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=EXECUTABLE, args=[*ARGUMENTS, *arguments])
        try:
            yield browser
        finally:
            browser.close()
