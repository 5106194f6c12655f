"""Destinations of prediction records, such as standard output, files and datagrams.

Other packages can add further destinations.

`output` defines what an output is. Each kind of output has its own module. The module `targets` registers the kinds,
and chooses one of them by the form of a target, such as `touch.csv` or `udp://127.0.0.1:9870`.

May import: export, record.
"""
