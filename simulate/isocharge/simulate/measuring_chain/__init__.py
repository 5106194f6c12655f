"""Models of the noise of single readings, and of amplifiers whose output also depends on earlier charges."""
