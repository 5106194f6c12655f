"""Description of sensors and probes, and the reader and writer of sensor files."""
