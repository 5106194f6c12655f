"""The Open Inference Protocol over HTTP: an ASGI application, and the server that runs it within bounds.

May import: network.protocol, network.
"""

from isocharge.common.extras import require

with require("http"):
    from isocharge.serve.network.http.app import App
    from isocharge.serve.network.http.server import HttpServer

__all__ = ["App", "HttpServer"]
