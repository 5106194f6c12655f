"""`python -m isocharge.cli`."""

from isocharge.cli import main

if __name__ == "__main__":
    main()
