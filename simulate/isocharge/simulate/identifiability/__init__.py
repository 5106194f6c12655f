"""Identifiability of contacts from charges: Cramer-Rao limits, folds, ambiguous pairs and the working area."""
