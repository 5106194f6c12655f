"""Prediction of contacts from tables of charges and from measured presses.

May import: model, presses, record, flags.
"""
