"""HTTP server of the Open Inference Protocol. The server limits the size and the duration of requests."""

from isocharge.common.extras import require

with require("http"):
    from isocharge.serve.network.http.server import HttpServer

__all__ = ["HttpServer"]
