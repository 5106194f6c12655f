"""The film's physics, dimensionless: membrane and bending energy, stress, and which theory a press needs."""
