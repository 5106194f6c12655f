"""The Bayes limit, by integrating the posterior of a contact."""
