"""Where bytes come from and when: serial port, file, recording, and the device's clock.

May import: nothing else of isocharge.serve.
"""
