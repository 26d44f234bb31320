"""A network in C: every neuron once; of ReLU, its row is shared by all leaves of the tree that the network is."""

from __future__ import annotations

import itertools
import re

import numpy as np

from otr.core.network import ReluNetwork
from otr.core.smooth_network import ACTIVATIONS, Layered, SmoothNetwork
from otr.programs.c.answers import Answer
from otr.programs.c.tables import CType, Table, literal, real_table

# The units of ACTIVATIONS in C: @ stands for the f of a function, or of a number, in single precision.
_SOFTPLUS = "(z > 20 ? z : (z > 0 ? z : 0) + log1p@(exp@(-fabs@(z))))"
UNITS = {
    "tanh": "tanh@(z)",
    "sigmoid": "1 / (1 + exp@(-z))",
    "silu": "z / (1 + exp@(-z))",
    "elu": "z > 0 ? z : expm1@(z)",
    "gelu": "0.5@ * z * (1 + erf@(z * 0.70710678118654752@))",
    "celu": "z > 0 ? z : expm1@(z)",
    "selu": "1.0507009873554805@ * (z > 0 ? z : 1.6732632423543772@ * expm1@(z))",
    "softplus": _SOFTPLUS,
    "softsign": "z / (1 + fabs@(z))",
    "mish": f"z * tanh@({_SOFTPLUS})",
    "logsigmoid": "(z < 0 ? z : 0) - log1p@(exp@(-fabs@(z)))",
    "hardtanh": "z < -1 ? -1 : z > 1 ? 1 : z",
    "relu6": "z < 0 ? 0 : z > 6 ? 6 : z",
    "hardsigmoid": "(z < -3 ? 0 : z > 3 ? 6 : z + 3) / 6",
    "hardswish": "z * (z < -3 ? 0 : z > 3 ? 6 : z + 3) / 6",
}
assert UNITS.keys() == ACTIVATIONS.keys()


def network_code(network: Layered, answer: Answer, name: str, dtype: CType) -> tuple[list[Table], list[str]]:
    """Return tables, and the lines that write the affine outputs to their array; one hidden layer at least."""
    if isinstance(network, ReluNetwork) and len(network.weights) == 2 and network.dense is False:
        tables, lines = _one_layer(network, answer.array, name, dtype)
    else:
        tables, lines = _layers(network, answer.array, name, dtype)
    return tables, [*answer.declared, *lines]


def functions_of(network: Layered) -> list[str]:
    """Return the functions of the mathematical library that a network's units call."""
    return re.findall(r"(\w+)@\(", UNITS[network.activation]) if isinstance(network, SmoothNetwork) else []


def _activated(network: Layered, dtype: CType) -> str:
    """Return the activation of the pre-activation z."""
    if isinstance(network, SmoothNetwork):
        return UNITS[network.activation].replace("@", "" if dtype == "double" else "f")
    off = f"{literal(network.negative_slope, dtype)} * z" if network.negative_slope else "0"
    return f"z > 0 ? z : {off}"


def _one_layer(network: ReluNetwork, y: str, name: str, dtype: CType) -> tuple[list[Table], list[str]]:
    """Return the form of one hidden layer, which writes the array y.

    A neuron's row is its weights, its bias and what it adds to each output.
    """
    (W, V), (b, a) = network.weights, network.biases
    n, d, o = len(b), network.n_inputs, network.n_outputs
    tables = [
        real_table(f"{name}_neurons", np.column_stack((W, b, V.T)), dtype),
        real_table(f"{name}_biases", a, dtype),
    ]
    slope = network.negative_slope
    adding = [f"for (k = 0; k < {o}; k++)", f"    {y}[k] += row[{d + 1} + k] * z;"]
    if slope:
        active = ["        if (!(z > 0))", f"            z *= {literal(slope, dtype)};"]
        active += [f"        {line}" for line in adding]
    else:
        active = ["        if (z > 0)", *(f"            {line}" for line in adding)]
    return tables, [
        "    int i, k;",
        f"    for (k = 0; k < {o}; k++)",
        f"        {y}[k] = {name}_biases[k];",
        f"    for (i = 0; i < {n}; i++) {{",
        f"        const {dtype} *row = {name}_neurons[i];",
        f"        {dtype} z = row[{d}];",
        f"        for (k = 0; k < {d}; k++)",
        "            z += row[k] * x[k];",
        *active,
        "    }",
    ]


def _layers(network: Layered, y: str, name: str, dtype: CType) -> tuple[list[Table], list[str]]:
    """Return the form of any network, which writes the array y.

    A layer's row is its weights of activations, then of inputs, then its bias.
    """
    d, is_dense = network.n_inputs, isinstance(network, ReluNetwork) and network.dense is not False
    starts = [0, *itertools.accumulate(network.hidden_widths)]
    tables: list[Table] = []
    lines = [f"    {dtype} a[{starts[-1]}];  /* the activations of all hidden neurons */", "    int i, k;"]
    for layer, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        reads_x = layer == 0 or is_dense
        n_read = W.shape[1] - d * reads_x
        tables.append(real_table(f"{name}_layer_{layer}", np.column_stack((W, b)), dtype))
        lines += [
            f"    for (i = 0; i < {len(b)}; i++) {{",
            f"        const {dtype} *row = {name}_layer_{layer}[i];",
            f"        {dtype} z = row[{W.shape[1]}];",
        ]
        if n_read:
            first = starts[layer] - n_read
            read = f"a[{first} + k]" if first else "a[k]"
            lines += [f"        for (k = 0; k < {n_read}; k++)", f"            z += row[k] * {read};"]
        if reads_x:
            weight = f"row[{n_read} + k]" if n_read else "row[k]"
            lines += [f"        for (k = 0; k < {d}; k++)", f"            z += {weight} * x[k];"]
        if layer == len(network.weights) - 1:
            lines += [f"        {y}[i] = z;", "    }"]
        else:
            start = f"{starts[layer]} + " if starts[layer] else ""
            lines += [f"        a[{start}i] = {_activated(network, dtype)};", "    }"]
    return tables, lines
