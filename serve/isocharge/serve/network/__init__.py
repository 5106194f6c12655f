"""What every server shares: model store, statistics, bounds, address, TLS, token.

May import: prediction, model.
"""
