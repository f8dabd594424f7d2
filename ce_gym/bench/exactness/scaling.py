"""Mass matrices and torques of a robot whose gear ratios and rotors are scaled, from those of its four levels as it is.

Spinning rotors enter by `G_r^T J G_r`, which grows with the square of the ratios, and by their coupling to what carries
them, which grows with the ratios; both grow with the rotors' inertia. What rotors are at rest does not change.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ce_gym.bench.exactness.protocol import Array


def scaled(level: str, of_levels: Mapping[str, Array], ratio: ArrayLike, inertia: ArrayLike) -> Array:
    """Return a quantity that is linear in the rotors' kinetic energy, at a level.

    Args:
        level: Transmission level.
        of_levels: The quantity at every level of the robot as it is, the same shape each.
        ratio: Factor on all gear ratios, any shape that broadcasts with the quantity.
        inertia: Factor on the inertia of all rotors, likewise.
    """
    r, s = np.asarray(ratio), np.asarray(inertia)
    none = of_levels["none"]
    if level == "none":
        return none + 0.0 * r * s
    reflected = of_levels["armature" if level == "armature" else "coupled"] - none
    carried = of_levels["exact"] - of_levels["coupled"] if level == "exact" else 0.0
    return none + s * r**2 * reflected + s * r * carried
