"""Models of the measuring chain: noise of single readings, and an amplifier with memory."""
