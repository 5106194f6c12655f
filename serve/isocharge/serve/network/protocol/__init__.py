"""Open Inference Protocol, version 2, independent of the transport.

This package computes the response to each request and the status of the response.

May import: network, model.

The two transports, `isocharge.serve.network.http` and `isocharge.serve.network.grpc`, import this package. This package
does not import the transports.
"""

from isocharge.common.errors import require

with require("http"):
    from isocharge.serve.network.protocol.handler import Handler

__all__ = ["Handler"]
