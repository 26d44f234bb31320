"""Small problems whose best oblique tree is known."""

import numpy as np


def turned(Z, angle=0.7):
    """Z with its first two columns turned."""
    turn = np.eye(Z.shape[1])
    turn[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    return Z @ turn


def strips(n, seed=0):
    """Two long parallel strips in the plane, one a class; the normal of the line between them comes third.

    Each class is longest along its strip, so the reflection makes the normal an axis.
    """
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 2, n)
    Z = np.column_stack((rng.uniform(-5, 5, n), np.where(y == 1, 1.0, -1.0) + rng.uniform(-0.6, 0.6, n)))
    return turned(Z), y, turned(np.array([[0.0, 1.0]]))[0]


def halves(n, d, seed=0):
    """The two ends of a sausage along the diagonal of R^d, each class's longest direction, which comes third."""
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 2, n)
    normal = np.full(d, 1 / np.sqrt(d))
    across = rng.normal(size=(n, d)) * 1.2
    across -= np.outer(across @ normal, normal)
    return across + np.outer((2 * y - 1) * rng.uniform(0.2, 6.0, n), normal), y, normal


def rotated_xor(n, d=2, seed=0):
    """XOR of the signs along two oblique directions, with a margin."""
    rng = np.random.default_rng(seed)
    Z = rng.uniform(0.1, 1.0, (n, d)) * rng.choice([-1.0, 1.0], (n, d))
    return turned(Z, np.pi / 4), ((Z[:, 0] > 0) ^ (Z[:, 1] > 0)).astype(int)
