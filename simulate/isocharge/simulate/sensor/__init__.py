"""What the sensor is and what presses it: film, electrodes, probe, and their TOML file."""
