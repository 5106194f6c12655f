"""The live page: what a sensor sees, in a browser, as it happens or from a recording.

May import: network.http, network.protocol, network, model, prediction, flags.

The process that reads a port never waits for a page: it writes samples of fixed size into a pipe (`link`), and another
process answers browsers (`hub`, `app`, `server`). The page itself is the folder `page`.
"""
