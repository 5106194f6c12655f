"""Prediction of contacts from charges, without a server, for single presses, tables of charges and measured presses.

May import: model, flags.
"""
