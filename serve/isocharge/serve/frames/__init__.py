"""From bytes to frames: every wire format, knowing no port.

May import: flags.

A format is a parser (`frame.Parser`) in a module here. The device file (`live.device_file`) names it, or `autodetect`
recognises it.
"""
