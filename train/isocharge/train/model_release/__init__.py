"""Release of a fitted network as a model folder with measured errors, an ONNX graph, a card and golden vectors."""
