"""Where the electrodes should lie: the case, the table of charges, the error that is made small, the search."""
