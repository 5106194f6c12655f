"""Reading and writing of files with named columns of numbers.

The modules `csv_table` and `parquet_table` convert a file of their format to columns. The module `number_table` checks
the names, the values and the number of rows. The module `table_file` chooses the format according to the name of the
file.
"""
