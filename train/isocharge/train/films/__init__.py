"""Network for all films: its training data, its training, its file, and the computation of the model of one film."""
