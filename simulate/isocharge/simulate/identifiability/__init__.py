"""What charges determine about a contact: Cramer-Rao limits, folds, ambiguous pairs, working area."""
