"""Modules that the HTTP server and the gRPC server share, such as the model store, the statistics, the limits and the
token.

May import: prediction, model.
"""
