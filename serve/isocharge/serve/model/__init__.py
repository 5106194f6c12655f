"""Folders of models: their metadata, ONNX sessions, golden vectors and charge maps, and the prediction of contacts.

May import: flags. The package `isocharge.train` also uses this package.
"""
