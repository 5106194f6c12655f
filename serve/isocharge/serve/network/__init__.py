"""HTTP server and gRPC server for models, and the modules that both servers share.

The shared modules include the model store, the statistics, the limits and the token.

May import: model.
"""
