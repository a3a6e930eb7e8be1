"""Public data sets as sequences, one module a data set."""
