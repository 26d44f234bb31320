"""A small deterministic world for DAgger, and oracles for it."""

from dataclasses import dataclass

import numpy as np

import otr

PUSHES = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])


@dataclass(frozen=True)
class Played:
    states: np.ndarray
    returns: np.ndarray
    lengths: np.ndarray


class PointMass:
    """A point in the plane is pushed one of four ways a step; an episode's return is less the nearer it stays to 0.

    Keeps a record of what was asked, and can be told to fail at its n-th call.
    """

    def __init__(self, n_steps=12, fail_at=None, continuous=False):
        self.n_steps, self.fail_at, self.continuous = n_steps, fail_at, continuous
        self.calls = []

    def __call__(self, policy, seeds, keep_states):
        if self.fail_at is not None and len(self.calls) == self.fail_at:
            raise InterruptedError("killed")
        self.calls.append((tuple(seeds), keep_states))
        x = np.array([np.random.default_rng(seed).normal(size=2) * 2 for seed in seeds])
        visited, returns = [], np.zeros(len(seeds))
        for _ in range(self.n_steps):
            visited.append(x)
            actions = policy(x)
            x = x + 0.3 * (actions if self.continuous else PUSHES[actions])
            returns -= np.abs(x).sum(axis=1)
        states = np.stack(visited, axis=1).reshape(-1, 2) if keep_states else np.empty((0, 0))
        return Played(states, returns, np.full(len(seeds), self.n_steps))


def centering_oracle():
    """Pushes back along the coordinate that is further off: outputs (-x, x, -y, y), by one hidden layer."""
    turn = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    return otr.ReluNetwork([turn, np.eye(4)[[1, 0, 3, 2]]], [np.zeros(4), np.zeros(4)], head=otr.Argmax())


def continuous_oracle():
    W = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    out = np.array([[-1.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]])
    return otr.ReluNetwork([W, out], [np.zeros(4), np.zeros(2)], head=otr.ClipBox(-1.0, 1.0))


def episode_seeds(name, index, n):
    """Streams that share no seed."""
    start = 10**7 * ["oracle", "dagger", "selection"].index(name) + 10**4 * index
    return list(range(start, start + n))
