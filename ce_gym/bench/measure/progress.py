"""How far a benchmark is, on a terminal; nothing where nobody looks."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TypeVar

T = TypeVar("T")


def shown(items: Collection[T], what: str) -> Iterator[T]:
    """Iterate over items with a progress bar on stderr, if that is a terminal and tqdm is installed."""
    try:
        from tqdm import tqdm
    except ImportError:
        return iter(items)
    return iter(tqdm(items, what, leave=False, disable=None, dynamic_ncols=True))
