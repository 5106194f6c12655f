"""Prediction records for other tools: MCAP files with ROS 2 messages.

MCAP files need the extra `record`.

May import: record.
"""
