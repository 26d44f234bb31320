"""The pendulum's optimum: the best mean return that any policy has on the starts on which policies are evaluated.

Pendulum-v1 has two states, the angle and its rate, so value iteration over the 200 steps of an episode answers it: on
a grid of angles and rates, bilinear in between, with every rate of the grid within the torque's reach as a choice. The
action that is greedy in these values is then played on the exact plant, whose mean return some policy therefore has;
the values at the starts say the same from the grid's side. Finer grids raise both: at half the points they return less.

The 5,000 starts are those of `evaluate`, of seeds 1000 to 5999. Means of 100 of them, as the thesis plays, scatter with
the standard deviation that the details give. Target: none, this only informs; it takes some minutes.
"""

import numpy as np

from benchmarks.measure import Entry
from otr.core.arrays import FloatArray

STEP_S, MAX_RATE, MAX_TORQUE, N_STEPS = 0.05, 8.0, 2.0, 200
PULL = 15 * STEP_S  # of gravity, on the rate in a step, times the sine of the angle
GAIN = 3 * STEP_S  # of a torque, on the rate in a step
FIRST_SEED, N_STARTS = 1000, 5000
GRID, QUICK_GRID = (720, 641), (90, 81)  # angles, rates
N_TORQUES = 161  # that greedy play compares


def measure(quick: bool) -> list[Entry]:
    """Return the entry; quick takes an eighth of the points each way, and 200 starts."""
    starts = evaluation_starts(200 if quick else N_STARTS)
    costs = value_iteration(*(QUICK_GRID if quick else GRID))
    returns = greedy_returns(costs, starts)
    details = {
        "value_at_starts": float(-interpolated(costs[-1], *starts.T).mean()),
        "std_of_means_of_100": float(returns.std() / 10),
        "n_starts": len(starts),
        "n_angles": costs[0].shape[0],
        "n_rates": costs[0].shape[1],
    }
    return [Entry("Pendulum-v1, the best mean return", float(returns.mean()), "return", clock=None, details=details)]


def evaluation_starts(n: int) -> FloatArray:
    """Return the angles and rates (n, 2) that Pendulum-v1 starts from by the evaluation's seeds."""
    import gymnasium

    env, starts = gymnasium.make("Pendulum-v1").unwrapped, []
    for seed in range(FIRST_SEED, FIRST_SEED + n):
        env.reset(seed=seed)
        starts.append(env.state.copy())  # type: ignore[attr-defined]
    return np.array(starts)


def value_iteration(n_angles: int, n_rates: int, n_steps: int = N_STEPS) -> list[np.ndarray]:
    """Return the least costs of 0 to `n_steps` steps, each (n_angles, n_rates), float32.

    Angles are -pi + 2 pi i / n_angles, rates lie evenly from -8 to 8.
    """
    angles, rates = np.arange(n_angles) * 2 * np.pi / n_angles - np.pi, np.linspace(-MAX_RATE, MAX_RATE, n_rates)
    gap, rows, columns = rates[1] - rates[0], np.arange(n_angles)[:, None], np.arange(n_rates)[None]
    here = (angles[:, None] ** 2 + 0.1 * rates[None] ** 2).astype(np.float32)
    ahead = (angles[:, None] + rates[None] * STEP_S + np.pi) * n_angles / (2 * np.pi)  # of an angle, by its next rate
    low, share = np.floor(ahead).astype(int) % n_angles, (ahead % 1).astype(np.float32)
    drift = rates[None] + PULL * np.sin(angles)[:, None]  # the next rate without a torque
    choices = []  # the rates that a torque leads to: between two of the grid (column, share), and its cost
    for torque in (-MAX_TORQUE, 0.0, MAX_TORQUE):
        place = (np.clip(drift + GAIN * torque, -MAX_RATE, MAX_RATE) + MAX_RATE) / gap
        column = np.minimum(place.astype(int), n_rates - 2)
        choices.append((column, (place - column).astype(np.float32), np.float32(0.001 * torque**2)))
    nearest, reach = np.round((drift + MAX_RATE) / gap).astype(int), int(GAIN * MAX_TORQUE / gap) + 1
    costs = [np.zeros((n_angles, n_rates), np.float32)]
    for _ in range(n_steps):
        after = (1 - share) * costs[-1][low, columns] + share * costs[-1][(low + 1) % n_angles, columns]
        best = np.full_like(here, np.inf)
        for column, part, price in choices:
            best = np.minimum(best, (1 - part) * after[rows, column] + part * after[rows, column + 1] + price)
        for offset in range(-reach, reach + 1):
            column = np.clip(nearest + offset, 0, n_rates - 1)
            torques = (rates[column] - drift) / GAIN
            cost = after[rows, column] + (0.001 * torques**2).astype(np.float32)
            best = np.minimum(best, np.where(np.abs(torques) <= MAX_TORQUE, cost, np.float32(np.inf)))
        costs.append(here + best)
    return costs


def interpolated(costs: np.ndarray, angles: FloatArray, rates: FloatArray) -> FloatArray:
    """Return the bilinear costs at these angles, of any turn, and rates, arrays of one shape."""
    n_angles, n_rates = costs.shape
    i, j = (angles + np.pi) * n_angles / (2 * np.pi), (rates + MAX_RATE) * (n_rates - 1) / (2 * MAX_RATE)
    row, column = np.floor(i).astype(int), np.minimum(np.floor(j).astype(int), n_rates - 2)
    a, b, row = i - row, j - column, row % n_angles
    above = (row + 1) % n_angles
    low, high = ((1 - b) * costs[r, column] + b * costs[r, column + 1] for r in (row, above))
    return np.asarray((1 - a) * low + a * high)


def greedy_returns(costs: list[np.ndarray], starts: FloatArray, n_torques: int = N_TORQUES) -> FloatArray:
    """Return the returns (n,) from starts (n, 2) of the torques that are best by the costs of the steps left."""
    angles, rates = starts.T.copy()
    torques, each, returns = np.linspace(-MAX_TORQUE, MAX_TORQUE, n_torques), np.arange(len(starts)), 0.0
    for left in costs[-2::-1]:
        drift = rates + PULL * np.sin(angles)
        next_rates = np.clip(drift[:, None] + GAIN * torques, -MAX_RATE, MAX_RATE)
        next_angles = angles[:, None] + next_rates * STEP_S
        chosen = (interpolated(left, next_angles, next_rates) + 0.001 * torques**2).argmin(axis=1)
        turned = (angles + np.pi) % (2 * np.pi) - np.pi
        returns = returns - (turned**2 + 0.1 * rates**2 + 0.001 * torques[chosen] ** 2)
        angles, rates = next_angles[each, chosen], next_rates[each, chosen]
    return np.asarray(returns)
