"""The prediction record.

The fields of a record are declared only once. All representations of a record are derived from this single declaration.

The module `record` declares the fields with their types, units and meanings, and the module `fields` reads the
declaration. Other modules derive the representations of a record from the declaration. The module `csv_rows` derives
the columns of CSV files, and the module `schema` derives the JSON Schema. The live page derives the layout of its
binary samples.
"""
