"""`isocharge simulate ...`: one module a command."""
