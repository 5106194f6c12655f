"""Programs that run to their end."""

import subprocess


def finished(words, **options):
    """Run a program to its end, and return its exit code, stdout and stderr as text. See `subprocess.run`."""
    return subprocess.run(words, capture_output=True, text=True, check=False, **options)
