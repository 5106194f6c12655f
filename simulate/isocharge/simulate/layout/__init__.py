"""Design of electrode layouts: a search for the electrode positions with the smallest position errors."""
