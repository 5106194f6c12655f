"""From charges to contacts in process: predictor, validity, prediction record, tables of charges.

May import: model, flags.
"""
