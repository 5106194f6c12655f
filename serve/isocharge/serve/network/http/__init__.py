"""Server on uvicorn that limits the requests to an ASGI application."""

from isocharge.common.errors import require

with require("http"):
    from isocharge.serve.network.http.server import HttpServer

__all__ = ["HttpServer"]
