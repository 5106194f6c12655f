"""Modules that simulate, train, serve and the commands share: errors, files, tables, progress and resumable runs.

These modules do not import any other package of isocharge.
"""
