"""Commands of the group `isocharge simulate`, with one module for each command."""
