"""The prediction record.

The fields of a record are declared only once, with their types, units and meanings, in the module `record`. The module
`formats` derives the columns of CSV files and the JSON Schema from the declaration. The live page derives the layout of
its binary samples.
"""
