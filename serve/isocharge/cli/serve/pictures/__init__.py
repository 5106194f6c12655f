"""Pictures of what was served: a recording.

May import: nothing else of isocharge.cli.
"""
