"""From true charges to readings: noise, the charge amplifier, their named levels and TOML file.

May import: nothing else of isocharge.simulate.
"""
