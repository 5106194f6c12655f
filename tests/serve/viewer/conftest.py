"""Fixtures that run the server of the live page in a thread, and connect viewers to it."""

import asyncio
import json
import struct
import urllib.request
from threading import Event, Thread

import numpy as np
import pytest
from websockets.asyncio.client import connect

from headless_chromium import start_chromium
from isocharge.serve.network.address import Address
from isocharge.serve.viewer.link import make_link
from isocharge.serve.viewer.messages import HEADER, SampleFormat, describe_film
from isocharge.serve.viewer.process import Page, run_page

NAMES = ("A", "B", "C")


@pytest.fixture(scope="module")
def chromium():
    """Return a headless browser."""
    with start_chromium() as browser:
        yield browser


class RunningPage:
    """A live page whose server runs in a thread.

    Attributes:
        reader: End of the link that sends samples and messages to the page.
        url: URL of the page.
        form: Format of the samples.
    """

    def __init__(self, metadata, **settings):
        self.form = SampleFormat(NAMES)
        self.reader, end = make_link()
        page = Page(end, describe_film("a film", metadata, None), Address(), **settings)
        self.url = ""
        self._listens = Event()
        self._thread = Thread(target=run_page, args=(page, self._announce))
        self._thread.start()
        assert self._listens.wait(20)

    def _announce(self, url):
        self.url = url
        self._listens.set()

    @property
    def live(self):
        return self.url.replace("http", "ws", 1) + "/live"

    def get(self, path, **headers):
        request = urllib.request.Request(self.url + path, headers=headers)
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.headers, answer.read()

    def stop(self):
        self.reader.close()
        self._thread.join(timeout=20)
        assert not self._thread.is_alive()


@pytest.fixture
def start_page(film):
    """Return a function that starts a page. The pages are stopped when the test ends."""
    started = []

    def start(**settings):
        started.append(RunningPage(film.metadata(), **settings))
        return started[-1]

    yield start
    for page in started:
        page.stop()


@pytest.fixture
def page(start_page):
    return start_page()


class Client:
    """A WebSocket client that confirms messages as the page does."""

    def __init__(self, socket, form):
        self.socket = socket
        self.form = form

    async def samples(self, confirm=True):
        """Return the header and the samples of the next message with samples. Text messages are ignored."""
        while True:
            data = await asyncio.wait_for(self.socket.recv(), 20)
            if isinstance(data, bytes):
                header = HEADER.unpack_from(data)
                if confirm:
                    await self.confirm(header[3])
                return header, np.frombuffer(data, self.form.dtype, offset=HEADER.size)

    async def text(self, key):
        """Wait for a text message with a key, and return the value of the key."""
        while True:
            data = await asyncio.wait_for(self.socket.recv(), 20)
            if isinstance(data, bytes):
                await self.confirm(HEADER.unpack_from(data)[3])
                continue
            content = json.loads(data)
            if key in content:
                return content[key]

    async def confirm(self, number):
        await self.socket.send(struct.pack("<I", number))

    async def ask(self, **content):
        await self.socket.send(json.dumps(content))


@pytest.fixture
def viewer():
    """Return a function that runs a coroutine function with a client of a page."""

    def run(page, talk, **options):
        async def follow():
            async with connect(page.live, **({"subprotocols": ["isocharge.live.1"]} | options)) as socket:
                return await talk(Client(socket, page.form))

        return asyncio.run(follow())

    return run
