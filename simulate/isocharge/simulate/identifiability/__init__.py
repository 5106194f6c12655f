"""Analysis of how well the charges of a sensor determine a contact, and in which area the contact is unique."""
