"""Folders of models: their metadata, ONNX sessions, golden vectors and companion files, and the search for a model.

May import: nothing else of isocharge.serve.
"""
