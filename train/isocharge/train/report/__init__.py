"""Report that compares methods by speed and error. All methods are tested on the same presses.

Example:
    The function `write_report` needs datasets, each with the folder of the model that is evaluated on it.

    from isocharge.train.report import write_report

    write_report(Path("report"), [(read_dataset(Path("presses")), find_model("three-25um-biaxial"))])
"""

from isocharge.common.errors import require

with require("train"):
    from isocharge.train.report.evaluation import QUICK, Settings
    from isocharge.train.report.page import write_report

__all__ = ["QUICK", "Settings", "write_report"]
