"""Pictures of films, charges and errors, which are drawn with matplotlib.

No other package of isocharge.simulate imports matplotlib.
"""
