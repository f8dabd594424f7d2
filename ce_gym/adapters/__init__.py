"""Thin shells that show a batched environment to a learning library in that library's own terms.

Each module imports the library it serves, so none is imported here: `import ce_gym` stays free of torch.
"""
