"""Prediction records for other tools: MCAP files with ROS 2 messages, and traces of a recording for its picture.

It takes records as their line of JSON and knows nothing of where they come from. MCAP needs the extra `record`.

May import: nothing else of isocharge.serve.
"""
