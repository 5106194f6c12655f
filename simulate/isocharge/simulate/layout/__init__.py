"""Design of electrode layouts: design case, table of charges, position error, and search of the positions."""
