"""ASGI application of the Open Inference Protocol, and a server on uvicorn that limits its requests."""

from isocharge.common.extras import require

with require("http"):
    from isocharge.serve.network.http.application import Application
    from isocharge.serve.network.http.server import HttpServer

__all__ = ["Application", "HttpServer"]
