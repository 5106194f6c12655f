"""The report on speed against error: every method on the same presses, with the limits drawn in.

from isocharge.train.report import write_report

write_report(Path("report"), [(read_dataset(Path("presses")), find_model("three-25um-biaxial"))])
"""

from isocharge.common.extras import require

with require("train"):
    from isocharge.train.report.build import write_report
    from isocharge.train.report.case import QUICK, Settings

__all__ = ["QUICK", "Settings", "write_report"]
