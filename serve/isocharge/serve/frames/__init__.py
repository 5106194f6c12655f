"""From bytes to frames: every wire format, knowing no port.

May import: flags.
"""
