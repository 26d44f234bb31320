"""Trees from data, in scikit-learn's manner."""
