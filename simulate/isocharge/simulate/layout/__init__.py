"""Design of a layout: design case, table of charges, position error, search of the electrode positions."""
