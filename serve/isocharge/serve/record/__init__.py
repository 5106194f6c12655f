"""The prediction record.

The fields of a record are declared only once, with their types and descriptions, in the module `record`. The module
`formats` derives the columns of CSV files and the JSON Schema from the declaration.
"""
