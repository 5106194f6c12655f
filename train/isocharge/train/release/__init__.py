"""From a trained network to a model folder: ONNX graph, measured errors, card, golden vectors.

May import: training, data.
"""
