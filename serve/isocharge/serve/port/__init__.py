"""Sources of bytes and their times, such as serial ports, files and recordings, and the clock of the device.

May import: nothing else of isocharge.serve.
"""
