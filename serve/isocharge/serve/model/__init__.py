"""The model folder: metadata, ONNX session, golden vectors, Triton's configuration, look-up by name.

May import: nothing else of isocharge.serve.
"""
