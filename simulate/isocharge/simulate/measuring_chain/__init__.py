"""From true charges to readings: noise, the charge amplifier, their named levels and TOML file."""
