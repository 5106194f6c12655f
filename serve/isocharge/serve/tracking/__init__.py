"""Tracking of a contact over successive frames.

Tracking combines the information of many frames, and thereby reduces the noise of the estimated position and force.
"""
