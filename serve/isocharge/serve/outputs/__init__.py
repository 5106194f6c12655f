"""Destinations to which prediction records are written, such as standard output, files and datagrams.

Other packages can add further destinations.

The module `output` defines the interface of an output. The module `targets` registers the kinds of outputs. The kind of
an output is chosen by the form of its target, such as `touch.csv` or `udp://127.0.0.1:9870`.

May import: record.
"""
