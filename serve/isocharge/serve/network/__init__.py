"""What every server shares: model store, statistics, bounds, address, TLS, token.

May import: prediction, model. Its packages: protocol (no transport), http, grpc.
"""
