"""Fixtures that serve a live page, and send requests to it."""

import json
import re
from contextlib import ExitStack

import pytest

from headless_chromium import start_chromium
from isocharge.serve.network.address import Address
from isocharge.serve.network.browser_check import AccessCheck
from isocharge.serve.viewer.film_description import describe_film
from isocharge.serve.viewer.live_page import LivePage, serve_page
from one_request import send


@pytest.fixture(scope="module")
def chromium():
    """Return a headless browser."""
    with start_chromium() as browser:
        yield browser


def errors_of(page):
    """Return a list to which the errors of a page are appended."""
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    return errors


class Client:
    """A client of a page: the page as the stream sees it, its address, and requests to it.

    Attributes:
        page: The page; None if another process serves it.
        url: Address of the page.
    """

    def __init__(self, page, url):
        self.page = page
        self.url = url

    def send(self, method, path, content=None, **headers):
        """Send a request, and return the status, the headers and the body of the response."""
        return send(self.url, method, path, content, **headers)

    def session(self):
        """Return the description of the film and of the samples."""
        return json.loads(self.send("GET", "/session.json")[2])

    def ask(self, do, **content):
        """Send a request of the page, and return the content of the response."""
        status, _, body = self.send("POST", "/request", {"do": do} | content)
        assert status == 200, body
        return json.loads(body)


@pytest.fixture
def start_page(film):
    """Return a function that serves a page until the test ends."""
    with ExitStack() as stack:

        def start(token=None, **settings):
            access = AccessCheck(token=token)
            page = LivePage(describe_film("a film", film.metadata()), access, **settings)
            return Client(page, stack.enter_context(serve_page(page, Address())))

        yield start


@pytest.fixture
def start_live(models, start_command):
    """Return a function that starts a command with a live page, and returns the process and a client of the page."""

    def start(*words):
        process = start_command("serve", *words, "--models", models, "--live", "127.0.0.1:0")
        while line := process.stderr.readline():
            if match := re.search(r"page: (http\S+?);?\s", line):
                return process, Client(None, match[1])
        raise AssertionError(process.communicate())

    return start


@pytest.fixture
def client(start_page):
    return start_page()
