"""`python -m isocharge.cli`."""

from isocharge.cli import main

main()
