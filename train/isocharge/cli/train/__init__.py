"""`isocharge train ...`: one file a command."""
