"""Reading and writing of files with named columns of numbers, with one module for each format.

`number_table` checks names, values and rows. `csv_table` and `parquet_table` turn their format into columns.
`table_file` chooses the format by the name of the file.
"""
