"""The Open Inference Protocol, version 2.

The package converts requests to answers and statuses, and does not depend on the transport.

May import: network, prediction, model.

The transports `isocharge.serve.network.http` and `isocharge.serve.network.grpc` import this package. The package
imports neither of them.
"""

from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.network.protocol.response import Response

__all__ = ["Handler", "Response"]
