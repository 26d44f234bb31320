"""What C and Python mean is read, or refused: against cc and Python on random functions, and case by case."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

import numpy as np
import pytest
from numpy.typing import NDArray

import otr

NAMES = ["x", "v"]
GRID = np.stack(np.meshgrid(*[np.arange(-2, 2.25, 0.25)] * 2), axis=-1).reshape(-1, 2)


class Writer:
    """Random functions that C or Python accepts; numbers are dyadic, so that answers are exact."""

    def __init__(self, random: Random, inputs: Sequence[str], numbers: Sequence[str]) -> None:
        self._random, self._inputs, self._numbers = random, inputs, numbers

    def some(self, usual: Sequence[str], rare: Sequence[str]) -> str:
        """Return one of the usual texts, or one time in twelve of the rare ones, most of which are refused."""
        return self._random.choice(usual if self._random.random() < 11 / 12 else rare)

    def number(self) -> str:
        return self._random.choice(self._numbers)

    def name(self) -> str:
        return self._random.choice(self._inputs)

    def compared(self, depth: int) -> str:
        signs = ("<", "<=", ">", ">=", "==", "!=")
        sign, other = self._random.choice(signs), self._random.choice(signs)
        a, b, c = (self.value(depth - 1) for _ in range(3))
        return self.some((f"{a} {sign} {b}",), (f"{a} {sign} {b} {other} {c}",))


class CWriter(Writer):
    """Functions of C."""

    def value(self, depth: int) -> str:
        if depth <= 0:
            return self._random.choice((self.number(), self.name(), self.name()))
        a, b, n = self.value(depth - 1), self.value(depth - 1), self.number()
        forms = (f"{a} + {b}", f"{a} - {b}", f"{n} * {a}", f"({a}) / {n}", f"{n} / {self.number()} * {a}", f"-({a})")
        forms += (f"fabs({a})", f"fmax({a}, {b})", f"fmin({a}, 1 / 2.0)")
        return self.some(forms, (f"abs({a})", f"{a} - -{n}", f"({n}, {a})", "010", "2u", "++u", "- --n"))

    def condition(self, depth: int) -> str:
        if depth <= 0:
            return self.compared(1)
        a, b = self.condition(depth - 1), self.condition(depth - 1)
        return self.some((self.compared(1), f"({a}) && ({b})", f"{a} || {b}", f"!({a})"), (f"!{a}", f"!({a}) < 1"))

    def statement(self, depth: int) -> str:
        value = self.value(2)
        if depth <= 0:
            usual = (f"u = u + {value};", f"return {value};", "n = 2;", f"u = u - {value};")
            return self.some(usual, (f"n = {value};", "1;", f"u += {value};", "{ double w = 1; }", "return 1 // 2\n;"))
        inner, other = self.statement(depth - 1), self.statement(depth - 1)
        end = self._random.choice(("\n", "\n    ", " "))
        test = f"if ({self.condition(1)})"
        usual = (f"{test}{end}{inner}", f"{test}{end}{inner}{end}else {other}", f"{test} {{ {inner} }} else {other}")
        return self.some(
            usual, (f"{test} {{ double u = 2; {other} }}", f"{{ {inner} }}", f"{{\n#if 0\n{inner}\n#endif\n u = 2; }}")
        )

    def function(self, name: str) -> str:
        kind, number = self.some(("double",), ("int", "char", "_Bool")), self.some(("1", "3"), ("0.5", "300", "1e10"))
        last = self.some((f"{self.value(1)} + u * n", f"{self.value(1)} + u"), (self.value(2), "n", "300", "0.5"))
        body = f"int n = {number};\ndouble u = {self.number()} * x[1];\n{self.statement(self._random.randint(0, 2))}\n"
        return f"{kind} {name}(const double x[2])\n{{\n{body}return {last};\n}}\n"


class PythonWriter(Writer):
    """Functions of Python."""

    def value(self, depth: int) -> str:
        if depth <= 0:
            return self._random.choice((self.number(), self.name(), self.name()))
        a, b, n = self.value(depth - 1), self.value(depth - 1), self.number()
        forms = (f"{a} + {b}", f"{a} - {b}", f"{n} * {a}", f"({a}) / {n}", f"max({a}, {b})", f"-{a} * {n}", f"abs({a})")
        rare = (f"{a} // {n}", f"({a}\n        // {n})", f"{a} ** 2", f"-{n} ** 2", f"{a} % {n}")
        return self.some((*forms, f"({a} if {self.compared(1)} else {b})"), rare)

    def condition(self, depth: int) -> str:
        if depth <= 0:
            return self.compared(1)
        a, b = self.condition(depth - 1), self.condition(depth - 1)
        usual = (self.compared(1), f"({a}) and ({b})", f"{a} or {b}", f"not {a}", f"{a} and {b}")
        return self.some(usual, (f"not {a} == ({b})",))

    def function(self, name: str) -> str:
        lines = [f"def {name}(x, v):", f"    u = {self.value(2)}", f"    if {self.condition(2)}:"]
        lines += [f"        {self.some(('return ', 'u = u + '), ('',))}{self.value(2)}"]
        lines += [f"    elif {self.condition(1)}: u = {self.value(1)}; u = u / 2"] * self._random.randint(0, 1)
        return "\n".join([*lines, f"    return u + {self.value(2)}"])


def assert_same_where_read(functions: Sequence[str], answers: Sequence[NDArray[np.float64]], n_read: int) -> None:
    """Check the answers of every function that is read, and that so many are."""
    n = 0
    for text, expected in zip(functions, answers, strict=True):
        try:
            tree = otr.parse_program(text, NAMES)
        except otr.ProgramError:
            continue
        np.testing.assert_array_equal(tree.predict(GRID)[:, 0], expected, err_msg=text)
        n += 1
    assert n >= n_read


def run_by_c(functions: Sequence[str], tmp_path: Path) -> list[NDArray[np.float64]]:
    """Return what each function of C named f0, f1, ... answers on the grid."""
    calls = "\n".join(f"case {i}: return f{i}(x);" for i in range(len(functions)))
    lines = ["#include <stdlib.h>", *functions, f"double call(int i, const double *x) {{ switch (i) {{\n{calls}\n}}"]
    (tmp_path / "f.c").write_text("\n".join([*lines, "return 0; }"]))
    subprocess.run(["cc", "-w", "-shared", "-fPIC", "-o", "f.so", "f.c"], cwd=tmp_path, check=True)
    call = ctypes.CDLL(str(tmp_path / "f.so")).call
    call.restype = ctypes.c_double
    states = [(ctypes.c_double * 2)(*state) for state in GRID]
    return [np.array([call(i, state) for state in states]) for i in range(len(functions))]


def test_random_functions_of_c(tmp_path: Path) -> None:
    writer = CWriter(Random(0), ["x[0]", "x[1]", "x[0]", "u", "n"], ["1", "2", "4", "0.5", "1.f", "2.0"])
    functions = [writer.function(f"f{i}") for i in range(1000)]
    assert_same_where_read(functions, run_by_c(functions, tmp_path), 50)


def run_by_python(text: str) -> NDArray[np.float64]:
    scope: dict[str, Callable[..., float]] = {}
    exec(text, scope)
    return np.array([scope["f"](*state) for state in GRID.tolist()], dtype=float)


def test_random_functions_of_python() -> None:
    writer = PythonWriter(Random(0), ["x", "v", "x", "v"], ["1", "2", "4", "0.5"])
    functions = [writer.function("f") for _ in range(1000)]
    assert_same_where_read(functions, [run_by_python(text) for text in functions], 50)


C_HEAD = "double f(const double *x) { "
REFUSED = [
    # text, line, words
    ("if (x[0] <= 0)\n  return 1/2*x[1]; else return 1.0f;", 2, "the quotient of two integers; write one as 2.0"),
    ("return x[0] <= 0;\n", 1, "a condition where a number was expected"),
    (C_HEAD + "\nreturn (1 + 2) / 2 * x[0]; }", 2, "the quotient of two integers"),
    (C_HEAD + "int i = 7;\nconst int j = 2;\ndouble u = -i / j; return u; }", 3, "the quotient of two integers"),
    (C_HEAD + "return max(1, 2) / 4; }", 1, "the quotient of two integers"),
    (C_HEAD + "\nint u = 2.7*x[0]; return u; }", 2, "'u' is an int, to which C rounds its value; write double u"),
    (C_HEAD + "int u;\nu = 3000000000; return u; }", 2, "'u' is an int"),
    ("int f(const double x[2])\n{\n return 0.6; }", 3, "C makes this a value of type int; write double, or integers"),
    ("bool f(const double x[2]) { return 2; }", 1, "of type bool; write double, or integers from 0 to 1"),
    ("uint8_t f(const double x[2]) { return 256; }", 1, "of type uint8_t; write double, or integers from 0 to 255"),
    ("int16_t f(const double x[2]) { return -32769; }", 1, "integers from -32768 to 32767"),
    ("unsigned f(const double x[2]) { return -1; }", 1, "integers from 0 to 127"),
    ("int f(const double x[2]) { double u = x[0]; return u; }", 1, "of type int"),
    ("double f(const int x[2]) { return x[0] / 2; }", 1, "const int x[2] holds integers, to which C rounds"),
    ("double f(int x, double v) { return x; }", 1, "int x holds integers"),
    ("void f(const double *x, int *u) { u[0] = x[0]; }", 1, "int *u holds integers"),
    (C_HEAD + "double u = 1; if (x[0] > 0) { double u = 2; } return u; }", 1, "a second 'u' hides the first"),
    ("void f(double *x) { x[0] = 2*x[0]; x[1] = x[0]; }", 1, "x[0] is both read and given a value"),
    ("int f(double *x, double *u) { u[0] = x[0]; return 0; }", 1, "this returns a value, and u[...] has values, too"),
    ("void f(double *x, double *u) { u[0] = x[0]\n- x[1]; }", 2, "a value alone is no answer in C; write return"),
    ("u = 2*x[0];\nu;", 2, "a value alone is no answer in C"),
    ("def f(x):\n    if x[0] > 0: 1\n    return 2", 2, "a value alone is no answer in Python; write return"),
    ("return x[0], x[1];", 1, "a comma leaves the last value alone; write y0 = ...; y1 = ...;"),
    ("if (0 <= x[0] <= 1) return 1.0; else return 2.0;", 1, "write a <= x && x <= b"),
    ("if (!x[0] <= 0) return 1; else return 2;", 1, "write !(...) around the comparison"),
    ("if (!(x[0]) <= 0) return 1; else return 2;", 1, "write !(...) around the comparison"),
    ("if (x[0] > 0)\n  if (x[1] > 0) return 1;\nelse return 2;\nreturn 3;", 3, "else belongs to the 'if' of line 2"),
    ("return abs(x[0]);", 1, "abs rounds to an integer in C; write fabs"),
    (C_HEAD + "int k = 100000;\nreturn k * k * x[0]; }", 2, "this may overflow an int of C; write a number of it as"),
    (C_HEAD + "return x[0] + 2 * (100000 * 100000); }", 1, "this may overflow an int"),
    (C_HEAD + "int k = 2;\nreturn 65536 * max(k, 1) * 65536 + x[0]; }", 2, "this may overflow an int"),
    (C_HEAD + "int k = 2;\nif (k + 2147483646 > x[0]) return 1; return 2; }", 2, "this may overflow an int"),
    (C_HEAD + "int k = 2; if (x[0] > 0)\nk = -2147483648;\nreturn x[0] - -k; }", 3, "this may overflow an int"),
    ("return -2147483647 - 2 + x;", 1, "this may overflow an int"),
    (C_HEAD + "double u = x[0]; return --u; }", 1, "-- changes a variable in C"),
    (C_HEAD + "double u = x[0]; double w = u++ + 1; return u + w; }", 1, "++ changes a variable in C"),
    ("double f(double x, double v) { double u = x; return 2u; }", 1, "2u is one number in C; write it without u"),
    (C_HEAD + "\nreturn x[0] > 0 ? 1.0 : -1.0; }", 2, "'?' has no meaning here; write a if ... else b"),
    ("return 010;", 1, "010 is octal in C; write 10"),
    ("return x[01];", 1, "01 is octal in C; write 1"),
    ("return 0x10;", 1, "0x10 is not decimal; write the decimal number"),
    ("#if 0\nreturn 1;\n#endif\nreturn 2;", 1, "C's preprocessor is not run here"),
    (C_HEAD + "// a \\\n return 1;\n return x[0]; }", 1, "C's preprocessor is not run here"),
    ("if x <= 0:\n    return v // 2\nelse: return 1", 2, "// is a division that rounds down in Python"),
    ("return 3//2", 1, "begin a comment with #"),
    ("/* a\n b */ return x // /* 2\n// */", 2, "// is a division"),
    ("return x /* 2", 1, "expected a number"),
    ("return (x\n    // 2\n    + v)", 2, "// is a division"),
    ("u = 2 * x; w = u\nreturn w // 2", 2, "// is a division"),
    ("u = x // 2;\nreturn u;", 1, "// is a division"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "words"), REFUSED, ids=[row[0][:40] for row in REFUSED])
def test_another_meaning_is_refused_at_its_line(text: str, line: int, words: str) -> None:
    with pytest.raises(otr.ProgramError) as caught:
        otr.parse_program(text, ["x", "v"])
    assert words in caught.value.reason
    assert caught.value.line == line


@pytest.mark.parametrize(
    "text",
    [
        "int f(const double *x)\n{\n    int a = 2;\n    if (x[0] > 0) a = 3;\n    return a;\n}",
        "int32_t f(const double *x) { if (x[0] > 0) return 3; return 2; }",
        "if (x[0] > 0) // right\n    return x[0]*0 // nothing\n        + 6/2.0;\nelse return 2;",
        C_HEAD + "if (x[0] > 0) { double u = 3; return u; } else { double u = 2; return u; } }",
        "double f(double *x, int n) { if (x[0] > 0) return 3; return max(2, 2); }",
        "if x > 0 {\n    return 3 // right\n} else {\n    return 4/2\n}",
        "/* reads x[2] numbers */ double f(const double x[2]) { if (x[0] > 0) return 3; return 2; /* if (x[0] */ }",
        f"#include <math.h> /* a\n * x[9] */\n{C_HEAD}\n  /* int u; */ if (x[0] > 0)\n    return/**/3;\nreturn 2; }}",
        C_HEAD + "int k = 46340; if (x[0] > 0) return 3 + 0 * x[0] * k * k * k; return k * k - 2147395600 + 2; }",
        C_HEAD + "int k = -3; if (x[0] > 0) return -k; return 3000000000 * 0.0 + 100000.0 * 100000 - 9999999998; }",
        "u = 100000 * 100000 / 1e10\nif x > 0 then 3 u else 2 u",
        "double f(double x, double v) {\n\tif (x > 0)\n        return 3;\n \t/* so */ return 2;\n}",
        "if (x > 0)\n\treturn 3\n  + 0;\nelse\n        return 2;",
        "float f(const float *x) { return fmaxf(fminf(fabsf(x[0]) + x[0], 0.125f) * 8.0f, 0.0f) + 2; }",
        "double f(double x, double v) { return 3.0 if x > 0 else 2.0; }",
        "if x > 0: 3 # not /* here\nelse: 2 /* :\n else */",
        "u = 1/2\nif 0 < x <= 9 then 6 u else 4 u",
        "def f(x, v):\n    u = 1; w = u / 2\n    return 6 * w if not x <= 0 else 4 * w",
    ],
)  # fmt: skip
def test_the_same_meaning_is_read(text: str) -> None:
    np.testing.assert_array_equal(
        otr.parse_program(text, NAMES).predict(GRID)[:, 0], np.where(GRID[:, 0] > 0, 3.0, 2.0)
    )


def test_a_label_of_a_function_of_integers_may_have_a_name() -> None:
    text = "action f(const double *x) { if (x[0] > 0) return fire; return coast; }"
    tree = otr.parse_program(text, NAMES, labels=True, output_names=["coast", "fire"])
    assert tree.predict([[1.0, 0.0], [-1.0, 0.0]]).tolist() == [1, 0]


def test_what_looks_like_a_comment_in_a_name_is_none() -> None:
    assert otr.parse_program("2 a /*b + `/*`", ["a /*b", "/*"]).predict([1.0, 10.0]) == [12.0]
    assert otr.parse_program("2 `x*/` /* ` */ + `c`", ["x*/", "c"]).predict([1.0, 10.0]) == [12.0]
