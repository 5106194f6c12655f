"""The Open Inference Protocol, version 2, which converts requests to answers and statuses independently of the
transport.

May import: network, prediction, model.

The transports `isocharge.serve.network.http` and `isocharge.serve.network.grpc` import this package, which imports
neither of them.
"""

from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.network.protocol.response import Response

__all__ = ["Handler", "Response"]
