"""Estimators with the interface of scikit-learn: the door between NumPy and torch."""
