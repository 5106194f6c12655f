"""The Bayes limit, by integrating the posterior of a contact.

May import: nothing else of isocharge.train.
"""
