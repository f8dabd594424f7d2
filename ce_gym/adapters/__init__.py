"""Wrappers that give batched environments the interfaces of learning libraries.

Each module imports its library. This file imports none of the modules, so that `import ce_gym` does not import torch.
"""
