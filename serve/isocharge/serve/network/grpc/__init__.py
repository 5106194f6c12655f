"""gRPC server of the Open Inference Protocol, which uses the same models as the HTTP server.

May import: network.protocol, network.
"""
