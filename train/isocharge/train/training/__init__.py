"""Training of the network that estimates contacts from charges, with its configuration and its optimisers."""
