"""Commands of `isocharge simulate`, one module for each command."""
