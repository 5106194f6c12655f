"""The Open Inference Protocol, version 2, without a transport: requests in, answers out, as plain values.

HTTP (`isocharge.serve.http`) and gRPC (`isocharge.serve.grpc`) carry it; neither is imported here.
"""

from isocharge.serve.v2.handler import Handler, Response

__all__ = ["Handler", "Response"]
