"""Design of electrode layouts, which searches for the electrode positions with the smallest position errors."""
