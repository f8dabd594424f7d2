"""Commands of `python -m ce_gym` that train, evaluate and export policies."""
