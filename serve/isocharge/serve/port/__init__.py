"""Sources of bytes and their times: serial ports, files, recordings, and the clock of the device.

May import: nothing else of isocharge.serve.
"""
