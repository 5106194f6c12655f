"""The default numbers of a server's bounds: sizes, connections, seconds.

These numbers have no imports, so that `isocharge serve http --help` can show them at once.
"""

MAX_BATCH = 4096
"""Presses in one request, and the largest batch that Triton may form; the model's graph itself takes any."""

BODY_BYTES = 1 << 20
"""Body of one request, bytes, compressed or not: room for MAX_BATCH presses on four electrodes as JSON, all digits."""

CONNECTIONS = 1024
"""Connections that are open at a time."""

IDLE_SECONDS = 75.0
"""Time between two requests on one connection, s."""

HEADER_SECONDS = 10.0
"""Time for the headers of a request, s."""
