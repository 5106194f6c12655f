"""Pictures of a film, to scale, in mm and pC. The only package that imports matplotlib."""
