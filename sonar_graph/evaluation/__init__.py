"""Running estimators, judging them, and reporting: knows them only through their contract."""
