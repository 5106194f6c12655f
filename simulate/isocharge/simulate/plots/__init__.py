"""Pictures of films, charges and errors. No other package of isocharge.simulate imports matplotlib."""
