"""A film of your own: its parameters from a few presses, what they cannot identify, and a model of it."""
