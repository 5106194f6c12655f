"""Sources of bytes, such as serial ports, files and recordings, and the times at which the bytes were sent.

May import: model.
"""
