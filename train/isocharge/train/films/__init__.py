"""Network for all films: training data, training, file, and computation of the model of one film."""
