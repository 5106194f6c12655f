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
    "--host-resolver-rules=MAP evil.example 127.0.0.1",
    # The browser's own protection of local addresses must not hide what the server does.
    "--disable-features=LocalNetworkAccessChecks,BlockInsecurePrivateNetworkRequests,PrivateNetworkAccessSendPreflights",
)
"""Arguments: no network traffic of the browser itself, WebGL by software, and a name of another site."""


@contextmanager
def start_chromium() -> Iterator[Any]:
    """Run Chromium while the block runs. A test is skipped if Chromium or Playwright is not installed.

    If the environment variable `CHROMIUM` contains its path, as in `make browser`, the test is not skipped.

    Yields:
        The browser as an object of Playwright.
    """
    if "CHROMIUM" not in os.environ and shutil.which(EXECUTABLE) is None:
        pytest.skip(f"needs {EXECUTABLE} (apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=EXECUTABLE, args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()
