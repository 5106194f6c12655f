"""A film of your own: its parameters from a few presses, what they cannot tell, and a model that is right about it.

May import: films, release, training, data.
"""
