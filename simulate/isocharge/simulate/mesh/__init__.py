"""The mesh that follows the probe: its topology, the conformal map that places it, its elements."""
