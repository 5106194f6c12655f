"""Tracking of a contact over successive frames.

Tracking reduces the noise of the estimated position and force, because it combines the information of many frames.
"""
