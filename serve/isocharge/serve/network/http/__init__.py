"""HTTP server of the Open Inference Protocol, with limits of size and time."""

from isocharge.common.extras import require

with require("http"):
    from isocharge.serve.network.http.server import HttpServer

__all__ = ["HttpServer"]
