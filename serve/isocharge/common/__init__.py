"""Modules that are shared by the packages `simulate`, `train`, `serve` and `cli`.

For example, the modules handle errors, files and progress.

These modules do not import any other package of isocharge.
"""
