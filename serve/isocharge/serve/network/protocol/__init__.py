"""The Open Inference Protocol, version 2, without a transport: requests in, answers and statuses out.

May import: network, prediction, model.

The transports `isocharge.serve.network.http` and `isocharge.serve.network.grpc` import this package, which imports
neither of them.
"""

from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.network.protocol.response import Response

__all__ = ["Handler", "Response"]
