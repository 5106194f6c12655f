"""Commands of `isocharge train`, one in each file."""
