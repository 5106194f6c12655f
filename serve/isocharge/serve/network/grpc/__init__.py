"""The Open Inference Protocol over gRPC: `inference.GRPCInferenceService` on the same models as HTTP.

May import: network.protocol, network.
"""

from isocharge.common.extras import require

with require("grpc"):
    from isocharge.serve.network.grpc.server import grpc_server

__all__ = ["grpc_server"]
