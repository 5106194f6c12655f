"""Calibrating at the bench: events of port and keyboard, the screen, and the dialogue between them.

May import: shared.
"""
