"""Methods of other packages, and of anybody, as estimators."""
