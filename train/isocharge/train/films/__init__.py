"""One network for all films: its data, its training, its file, and the plain model of one film that folds out of it."""
