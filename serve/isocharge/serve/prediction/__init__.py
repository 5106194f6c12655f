"""Prediction of contacts from charges in the same process, for single presses, tables of charges and measured presses.

May import: model, flags.
"""
