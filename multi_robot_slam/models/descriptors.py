"""How alike two descriptors are (19)."""

import numpy as np


def squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """E (19) between the rows of `a` (B, 128) and of `b` (N, 128): (B, N)."""
    products = a @ b.T
    products *= -2
    products += np.einsum("ij,ij->i", b, b)
    products += np.einsum("ij,ij->i", a, a)[:, None]
    return products
