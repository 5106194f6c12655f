"""The report on speed against error: every method on the same presses, with the limits drawn in.

from isocharge.train.report import Settings, write_report

write_report(Path("report"), [(dataset, None)], Settings())
"""
