"""The Open Inference Protocol, version 2, without a transport: requests in, answers and statuses out.

May import: network, prediction, model.

HTTP (`isocharge.serve.network.http`) and gRPC (`isocharge.serve.network.grpc`) carry it; neither is imported here.
"""

from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.network.protocol.response import Response

__all__ = ["Handler", "Response"]
