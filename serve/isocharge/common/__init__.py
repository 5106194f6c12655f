"""Modules that are shared by the packages `simulate`, `train`, `serve` and `cli`.

For example, the modules handle errors, files and progress.

The modules do not import any other package of isocharge.
"""
