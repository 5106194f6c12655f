"""Description of a sensor and of probes: film, electrodes, probe shapes, and the reader of sensor files."""
