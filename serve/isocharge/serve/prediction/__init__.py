"""From charges to contacts in process: predictor, validity, record, tables of charges and of measured presses.

May import: model, flags.
"""
