"""A board that does not exist: script of presses, faults on request, a pseudo-terminal.

May import: frames.
"""
