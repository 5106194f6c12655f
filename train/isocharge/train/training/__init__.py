"""The network and how it is trained: configuration, optimisers, checkpoint.

May import: data.
"""
