"""What simulate, train, serve and the commands share: errors, files, tables, progress, runs that go on after a kill.

May import: nothing else of isocharge.
"""
