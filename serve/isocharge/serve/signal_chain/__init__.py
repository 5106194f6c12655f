"""From readings to touch charges: gain, hum, tare, leak, contact, thermal drift.

May import: flags.
"""
