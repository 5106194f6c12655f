"""What the HTTP server asks of an application: answers, and which of its paths are WebSockets."""

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, Protocol

from isocharge.serve.network.protocol import Response
from isocharge.serve.network.protocol.handler import Headers
from isocharge.serve.network.request_log import Client

Message = MutableMapping[str, Any]

Receive = Callable[[], Awaitable[Message]]

Send = Callable[[Message], Awaitable[None]]


class Answerer(Protocol):
    """Answers complete requests at once; as an ASGI application those that may take long, and WebSockets."""

    @property
    def blocks(self) -> Callable[[str], bool]:
        """Whether the answer to a path may take long."""

    def has_websocket(self, path: str) -> bool:
        """Whether there is a WebSocket under a path."""

    def watch_connections(self, count: Callable[[], int]) -> None:
        """Take what tells the number of open connections."""

    def answer(self, method: str, path: str, headers: Headers, body: bytes, client: Client = None) -> Response:
        """Answer one request."""

    def refused(self, response: Response, client: Client = None) -> None:
        """Take note of a refusal of the server's own: the request could not be read to its end."""

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """As ASGI."""
