"""Methods that a report compares with a model: regressors of scikit-learn that estimate contacts from charges.

The inputs of a method are charges, shape (n, n_electrode), pC. The outputs are contacts (x, y, F), shape (n, 3), mm and
N.

Example:
    from isocharge.train.baselines.compared_methods import compared_methods

    fitted = [method.fit(task) for method in compared_methods(task)]
    contact = fitted[0].regressor.predict(charge)
"""
