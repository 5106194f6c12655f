"""The live page: what a sensor sees, in a browser, as it happens or from a recording.

The process that reads a port never waits for a page: it writes samples of fixed size into a pipe (`link`), and another
process answers browsers (`process`, `hub`, `server`). The page itself is the folder `page`.
"""
