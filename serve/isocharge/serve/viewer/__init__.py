"""Live page, which shows the contacts of a live stream or of a recording in a browser.

Two processes work together. The reader is the process that reads a port. The reader writes samples of a fixed size into
a pipe (module `link`). The reader of a live stream never waits for the page. A separate process receives the samples
and sends them to browsers (modules `process`, `hub` and `server`). The folder `page` contains the HTML file, the
scripts and the style sheet of the page.
"""
