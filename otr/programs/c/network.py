"""A ReLU network in C: every neuron once, its row shared by all leaves of the tree that the network is."""

from __future__ import annotations

import itertools

import numpy as np

from otr.core.network import ReluNetwork
from otr.programs.c.answers import Answer
from otr.programs.c.tables import CType, Table, literal, real_table


def network_code(network: ReluNetwork, answer: Answer, name: str, dtype: CType) -> tuple[list[Table], list[str]]:
    """Return tables, and the lines that write the affine outputs to their array; one hidden layer at least."""
    one_layer = len(network.weights) == 2 and network.dense is False
    tables, lines = (_one_layer if one_layer else _layers)(network, answer.array, name, dtype)
    return tables, [*answer.declared, *lines]


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


def _layers(network: ReluNetwork, y: str, name: str, dtype: CType) -> tuple[list[Table], list[str]]:
    """Return the form of any network, which writes the array y.

    A layer's row is its weights of activations, then of inputs, then its bias.
    """
    d = network.n_inputs
    starts = [0, *itertools.accumulate(network.hidden_widths)]
    tables: list[Table] = []
    lines = [f"    {dtype} a[{network.n_hidden}];  /* the activations of all hidden neurons */", "    int i, k;"]
    for layer, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        reads_x = layer == 0 or network.dense is not False
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
            off = f"{literal(network.negative_slope, dtype)} * z" if network.negative_slope else "0"
            start = f"{starts[layer]} + " if starts[layer] else ""
            lines += [f"        a[{start}i] = z > 0 ? z : {off};", "    }"]
    return tables, lines
