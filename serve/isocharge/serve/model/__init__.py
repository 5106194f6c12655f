"""Model folders: metadata, ONNX session, golden vectors, companion files, Triton configuration, and search by name.

May import: nothing else of isocharge.serve.
"""
