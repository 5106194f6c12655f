"""The live page, which shows the contacts of a live stream or a recording in a browser.

The process that reads a port never waits for the page. The reading process writes samples of fixed size into a pipe
(`link`), and a separate process serves browsers (`process`, `hub`, `server`). The folder `page` contains the files of
the page.
"""
