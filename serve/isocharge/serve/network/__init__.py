"""Common parts of the HTTP and the gRPC server, such as the model store, the statistics, the limits and the token.

May import: prediction, model.
"""
