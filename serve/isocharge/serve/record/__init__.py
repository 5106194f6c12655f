"""The prediction record.

The fields of a record are declared once, and all other forms are derived from this declaration.

`record` declares the fields with their types, units and meanings. `fields` reads the declaration. `csv_rows`, `schema`
and `reference` derive the columns of CSV, the JSON Schema and the table of the documentation from this declaration. The
live page derives the layout of its binary samples from the same declaration.
"""
