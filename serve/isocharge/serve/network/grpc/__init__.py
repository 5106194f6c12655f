"""gRPC server of the Open Inference Protocol, which uses the same models as the HTTP server.

May import: network.protocol, network.
"""

from isocharge.common.errors import require

with require("grpc"):
    from isocharge.serve.network.grpc.server import grpc_server

__all__ = ["grpc_server"]
