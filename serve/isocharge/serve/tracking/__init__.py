"""Tracking of a contact from frame to frame, which improves the estimates of its position and its force."""
