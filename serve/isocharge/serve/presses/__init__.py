"""Files of measured presses: tables of numbers as CSV text, their headers, and the presses that they contain.

The package `isocharge.train` also uses this package.
"""
