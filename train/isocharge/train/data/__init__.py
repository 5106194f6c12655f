"""What a network learns from: presses, contact domain, fitted charge field, examples of misfit.

May import: nothing else of isocharge.train.
"""
