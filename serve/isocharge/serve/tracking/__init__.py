"""A contact in time: what the frames before say about where and how hard the film is touched now."""
