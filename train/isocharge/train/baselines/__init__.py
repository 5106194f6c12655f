"""Other methods to estimate a contact from charges, as regressors of scikit-learn, for the comparison in a report.

    from isocharge.train.baselines.compared_methods import compared_methods

    fitted = [method.fit(task) for method in compared_methods(task)]
    contact = fitted[0].regressor.predict(charge)

The charges have the shape (n, n_electrode), pC, and the contacts (x, y, F) the shape (n, 3), mm and N.
"""
