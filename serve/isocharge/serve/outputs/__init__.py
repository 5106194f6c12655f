"""Destinations to which prediction records are written, such as standard output, files and datagrams.

Other packages can add further destinations.

The module `output` defines the interface of an output. Each kind of output has its own module. The module `targets`
registers the kinds of outputs. This module also chooses the kind of an output by the form of the target, such as
`touch.csv` or `udp://127.0.0.1:9870`.

May import: export, record.
"""
