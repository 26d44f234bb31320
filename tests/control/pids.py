"""The PID policy that the thesis prints (Orfanos 2023, Fig. 4.4)."""

import numpy as np

import otr
from otr.control import pid_network

NAMES = ["x", "y", "w"]
GAINS = [3.15, 3.24, 0.65, 0.12, 0.52, 0.04, 10.94, 11.89, 0.13]  # of P, I, D where the neuron is off
TEST = [-15.7, -21.7, -8.48]
# On the other side theta_I = [-0.25 + 0.75 x + 1.04 y + 0.41 w, 0.52, 0.10 - 0.13 x - 0.17 y - 0.07 w]: these output
# weights times the test, to the digits printed.
OUTPUT_WEIGHTS = {3: -0.0479, 5: 0.0081}

PROGRAM = """\
P = [P_x, P_y, P_w]
I = [I_x, I_y, I_w]
D = [D_x, D_y, D_w]
if 7.78 - 15.7 x - 21.7 y - 8.48 w <= 0 then
    theta_P = [3.15, 3.24, 0.65]
    theta_I = [0.12, 0.52, 0.04]
    theta_D = [10.9, 11.9, 0.13]
    return 2 tanh(theta_P . P + theta_I . I + theta_D . D)
else
    theta_P = [3.15, 3.24, 0.65]
    theta_I = [
        -0.253 + 0.752 x + 1.04 y + 0.406 w,
        0.52,
        0.103 - 0.127 x - 0.176 y - 0.0687 w,
    ]
    theta_D = [10.9, 11.9, 0.13]
    return 2 tanh(theta_P . P + theta_I . I + theta_D . D)
"""


def gains_network(output_weights: dict[int, float] = OUTPUT_WEIGHTS) -> otr.ReluNetwork:
    weights = np.zeros((9, 1))
    for gain, weight in output_weights.items():
        weights[gain] = weight
    return otr.ReluNetwork([[TEST], weights], [[7.78], GAINS])


def thesis_policy() -> otr.ReluNetwork:
    """Return the policy of observations [s, P, I, D], with the torque in [-2, 2]."""
    return pid_network(gains_network(), [-2.0], [2.0])
