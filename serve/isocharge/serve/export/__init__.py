"""Conversion of prediction records to ROS 2 messages.

May import: record.
"""
