"""A tree in fixed point as an Arduino sketch: the policy, and a loop that answers integers from the serial port."""

from __future__ import annotations

from collections.abc import Sequence

from otr.core.fixed_point.tree import FixedPointTree
from otr.programs.c.source import to_c
from otr.programs.names import give_labels


def arduino_sketch(
    fixed: FixedPointTree,
    *,
    name: str = "policy",
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
) -> str:
    """Return a sketch that reads the inputs as a line of integers and prints the answers, to be replaced by sensors."""
    code = to_c(fixed, name=name, feature_names=feature_names, output_names=output_names)
    labelled, d, o = give_labels(fixed.to_tree()), fixed.n_inputs, fixed.n_outputs
    word = f"int{fixed.input_bits}_t"
    most = 2 ** (fixed.input_bits - 1) - 1
    held = (
        f"read < -{most}L - 1L ? -{most}L - 1L : read > {most}L ? {most}L : read" if fixed.input_bits < 32 else "read"
    )
    declared = [] if labelled else [f"    int{fixed.accumulator_bits}_t y[{o}];"]
    printed = (
        [f"    Serial.println({name}_label(x));"]
        if labelled
        else [
            f"    {name}(x, y);",
            f"    for (k = 0; k < {o}; k++) {{",
            "        Serial.print((long)y[k]);",
            f"        Serial.print(k < {o - 1} ? ' ' : '\\n');",
            "    }",
        ]
    )
    lines = [
        "",
        "void setup()",
        "{",
        "    Serial.begin(115200);",
        "}",
        "",
        "void loop()  /* replace what reads x by your sensors, and what prints by your actuators */",
        "{",
        f"    {word} x[{d}];",
        *declared,
        "    int k;",
        f"    for (k = 0; k < {d}; k++) {{",
        "        while (!Serial.available())",
        "            ;",
        "        long read = Serial.parseInt();",
        f"        x[k] = ({word})({held});",
        "    }",
        *printed,
        "}",
    ]
    return f"#include <Arduino.h>\n{code}" + "\n".join(lines) + "\n"
