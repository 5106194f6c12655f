"""One network for all films: its data, its training, its file, and the model of one film that is computed from it."""
