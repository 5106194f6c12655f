"""Other methods to estimate a contact from charges, as regressors of scikit-learn, for the comparison in a report.

The charges have the shape (n, n_electrode), pC. The contacts (x, y, F) have the shape (n, 3), mm and N.

Example:
    from isocharge.train.baselines.compared_methods import compared_methods

    fitted = [method.fit(task) for method in compared_methods(task)]
    contact = fitted[0].regressor.predict(charge)
"""
