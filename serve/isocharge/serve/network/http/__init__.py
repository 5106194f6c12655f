"""The Open Inference Protocol over HTTP, within bounds of size and time."""

from isocharge.common.extras import require

with require("http"):
    from isocharge.serve.network.http.server import HttpServer

__all__ = ["HttpServer"]
