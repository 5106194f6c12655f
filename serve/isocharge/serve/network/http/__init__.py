"""Server on uvicorn that limits the requests to an ASGI application."""

from isocharge.common.extras import require

with require("http"):
    from isocharge.serve.network.http.server import HttpServer

__all__ = ["HttpServer"]
