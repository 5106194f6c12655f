"""Pages that a browser opens from a file: everything is in the one file, nothing is fetched.

May import: identifiability.
"""
