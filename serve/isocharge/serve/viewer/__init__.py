"""Live page, which shows the contacts of a live stream or of a recording in a browser.

A `Tape` stores the samples of the stream, and a `LivePage` answers the requests of browsers. The folder `page` contains
the HTML file, the scripts and the style sheet of the page.
"""
