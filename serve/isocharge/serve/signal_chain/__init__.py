"""The signal chain: stages that turn the numbers of a board into touch charges.

May import: flags.
"""
