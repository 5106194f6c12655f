"""Every other way from charges to contacts, as regressors of scikit-learn's form, for the report on speed and error.

from isocharge.train.baselines.rivals import rivals

fitted = [rival.fit(task) for rival in rivals(task)]
contact = fitted[0].regressor.predict(charge)  # (n, n_electrode), pC, to (n, 3): x, y, mm, and force, N
"""
