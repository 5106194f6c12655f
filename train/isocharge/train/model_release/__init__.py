"""From a fitted network to a model folder: measured errors, ONNX graph, card, golden vectors."""
