"""`isocharge demo`: the whole path once, with pictures."""
