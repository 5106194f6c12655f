"""Modules that simulate, train, serve and the commands share: errors, files, tables, progress and resumable runs.

May import: nothing else of isocharge.
"""
