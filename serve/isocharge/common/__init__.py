"""Modules that are shared by the packages `simulate`, `train`, `serve` and `cli`.

The modules handle errors, files, tables of numbers, progress and resumable runs, among others.

These modules do not import any other package of isocharge.
"""
