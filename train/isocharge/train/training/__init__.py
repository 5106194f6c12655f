"""The network and how it is fitted: configuration, optimisers, fit."""
