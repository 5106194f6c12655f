"""Export of prediction records to MCAP files with ROS 2 messages, which other tools can read.

MCAP files need the extra `record`.

May import: record.
"""
