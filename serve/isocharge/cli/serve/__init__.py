"""`isocharge serve ...`: one file a command.

May import: isocharge.serve, when a command runs; shared, which brings the simulator to the virtual sensor.
"""
