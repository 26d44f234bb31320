"""C in integers: compiled under strict warnings, checked for MISRA's mandatory rules, run on emulated controllers."""

import ctypes
import re
import shutil
import subprocess
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import otr
from benchmarks.microcontrollers import TARGETS, answers_hash, run_on
from otr.programs.c.arduino import arduino_sketch
from tests.core.strategies import make_network
from tests.programs.policies import committed
from tests.programs.test_c import COMPILER, FLAGS, compiled

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler (gcc or cc) on the PATH")
N_STATES = 10_000


def fixed_trees() -> dict[str, otr.FixedPointTree]:
    rng = np.random.default_rng(0)
    made = {}
    heads = (("identity", 2), ("clip_box", 3), ("tanh_box", 2), ("sign", 1), ("argmax", 3))
    for (head, n_outputs), bits in zip(heads, (8, 16, 12, 16, 24), strict=True):
        tree = otr.map_network(make_network(rng, (3, 2), n_inputs=3, n_outputs=n_outputs, head=head))
        wide = 64 if bits == 24 else 32
        made[head] = otr.to_fixed_point(tree, (-4 * np.ones(3), 2 * np.ones(3)), bits, accumulator_bits=wide)
        if head in ("sign", "argmax"):
            undecided = tree.replace(labels=None)
            made[f"{head}_of_outputs"] = otr.to_fixed_point(undecided, (-np.ones(3), np.ones(3)), 12)
    made["one_leaf"] = otr.to_fixed_point(otr.parse_program("2 x - y", ["x", "y"]), ([-1, 0], [1, 3]))
    made["one_label"] = otr.to_fixed_point(otr.parse_program("1", ["x"], labels=True), ([-1], [1]), 8)
    sensor = otr.parse_program("if x <= 0.5: 0.7 - y / 3 else: 2 x", ["x", "y"]).replace(head=otr.ClipBox(-1, 1))
    made["sensor"] = otr.to_fixed_point(sensor, (0, 5), input_scales=["5/1023", 0.01], output_scales=[Fraction(1, 127)])
    made["hopper"] = otr.to_fixed_point(committed("hopper"), (-2 * np.ones(11), 2 * np.ones(11)))
    made["labels"] = otr.to_fixed_point(committed("lander"), (-2 * np.ones(8), 2 * np.ones(8)))
    made["wide_sums"] = otr.to_fixed_point(
        committed("hopper"), (-2 * np.ones(11), 2 * np.ones(11)), 16, accumulator_bits=64
    )
    return made


TREES = fixed_trees()


def integers_for(fixed: otr.FixedPointTree, n: int = N_STATES) -> NDArray:
    """Return inputs within their words, some beyond what is clamped."""
    edge = 2 ** (fixed.input_bits - 1)
    low, high = (np.clip(limit + beyond, -edge, edge - 1) for limit, beyond in ((fixed.input_low, -9),
                                                                                 (fixed.input_high, 9)))  # fmt: skip
    return np.random.default_rng(0).integers(low, high + 1, (n, fixed.n_inputs))


@needs_compiler
def test_the_same_integers_as_python(tmp_path: Path) -> None:
    sources = {name: otr.to_c(fixed, name=f"{name}_of") for name, fixed in TREES.items()}
    library = compiled(sources, tmp_path)
    for name, fixed in TREES.items():
        Q = integers_for(fixed)
        inputs = np.ascontiguousarray(Q, dtype=f"int{fixed.input_bits}")
        rows = [row.ctypes.data_as(ctypes.c_void_p) for row in inputs]
        if f" {name}_of_label(" in sources[name]:
            function = getattr(library, f"{name}_of_label")
            answers = [function(row) for row in rows]
        else:
            answers = np.zeros((len(Q), fixed.n_outputs), dtype=f"int{fixed.accumulator_bits}")
            for row, y in zip(rows, answers, strict=True):
                getattr(library, f"{name}_of")(row, y.ctypes.data_as(ctypes.c_void_p))
        np.testing.assert_array_equal(answers, fixed.predict_integers(Q), name)
        code = re.sub(r"/\*.*?\*/", "", sources[name], flags=re.S)
        assert not re.search(r"float|double|malloc|/ |\d\.\d", code), name


@needs_compiler
def test_the_file_tests_itself(tmp_path: Path) -> None:
    fixed = TREES["hopper"]
    source = otr.to_c(fixed, test_states=integers_for(fixed, 100))
    for text, code in ((source, 0), (source.replace("sum >> by", "sum >> (by + 1)"), 1)):
        (tmp_path / "policy.c").write_text(text)
        command = [str(COMPILER), *FLAGS, "-DPOLICY_TEST", str(tmp_path / "policy.c"), "-o", str(tmp_path / "test")]
        subprocess.run(command, check=True)
        assert subprocess.run([str(tmp_path / "test")], check=False).returncode == code
    with pytest.raises(ValueError, match="test_states are integers of a FixedPointTree"):
        otr.to_c(committed("hopper"), test_states=np.zeros((1, 11), dtype=int))


@needs_compiler
@pytest.mark.parametrize("name", ["hopper", "labels", "wide_sums"])
def test_a_plain_main_answers_integers_that_it_reads(name: str, tmp_path: Path) -> None:
    fixed = TREES[name]
    Q = integers_for(fixed, 50)
    (tmp_path / "policy.c").write_text(otr.to_c(fixed, test_states=Q))
    command = [str(COMPILER), *FLAGS, "-DPOLICY_MAIN", str(tmp_path / "policy.c"), "-o", str(tmp_path / "main")]
    subprocess.run(command, check=True)
    given = "\n".join(" ".join(map(str, q)) for q in Q.tolist())
    printed = subprocess.run([str(tmp_path / "main")], input=given, capture_output=True, text=True, check=True).stdout
    answers = np.array([line.split() for line in printed.splitlines()], dtype=int)
    np.testing.assert_array_equal(answers, fixed.predict_integers(Q).reshape(len(Q), -1))
    beyond = [100_000, -100_000] * (fixed.n_inputs // 2 + 1)  # no int16_t
    given = " ".join(map(str, beyond[: fixed.n_inputs]))
    printed = subprocess.run([str(tmp_path / "main")], input=given, capture_output=True, text=True, check=True).stdout
    held = np.clip(beyond[: fixed.n_inputs], fixed.input_low, fixed.input_high)
    assert [int(word) for word in printed.split()] == fixed.predict_integers(held[None]).ravel().tolist()


def test_python_of_integers_alone() -> None:
    for name, fixed in TREES.items():
        source, Q = otr.to_python(fixed, name="of"), integers_for(fixed, 1000)
        scope: dict = {}
        exec(source, scope)
        answers = [scope["of"](q) for q in Q.tolist()]
        np.testing.assert_array_equal(answers, fixed.predict_integers(Q), name)
        code = re.sub(r"#.*", "", source)
        assert "import" not in code and not re.search(r"\d\.\d|/", code), name


ARDUINO = """
struct Port { long next; void begin(long) {} int available() { return 1; } long parseInt() { return next++; }
    long printed; void print(long y) { printed = printed * 31 + y; } void print(char) {}
    void println(long y) { print(y); } };
extern struct Port Serial;
"""  # fmt: skip


@pytest.mark.skipif(shutil.which("avr-g++") is None, reason="avr-g++ is not installed (apt-get install gcc-avr)")
def test_the_arduino_sketch_compiles(tmp_path: Path) -> None:
    (tmp_path / "Arduino.h").write_text(ARDUINO)
    for name in ("hopper", "labels", "wide_sums"):
        (tmp_path / f"{name}.ino").write_text(arduino_sketch(TREES[name], name=f"{name}_of"))
        command = [
            "avr-g++",
            "-mmcu=atmega328p",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-Os",
            "-c",
            "-x",
            "c++",
            f"-I{tmp_path}",
        ]
        subprocess.run([*command, str(tmp_path / f"{name}.ino"), "-o", str(tmp_path / f"{name}.o")], check=True)


@pytest.mark.skipif(shutil.which("cppcheck") is None, reason="cppcheck is not installed (apt-get install cppcheck)")
@pytest.mark.slow
def test_misra(tmp_path: Path) -> None:
    for name, fixed in TREES.items():
        path = tmp_path / f"{name}.c"
        path.write_text(otr.to_c(fixed, name=f"{name}_of"))
        rules = ["--addon=misra", "--enable=all", "--suppress=missingIncludeSystem", "--quiet", "-DINT32_MAX"]
        done = subprocess.run(["cppcheck", *rules, str(path)], capture_output=True, text=True, check=True)
        found = set(re.findall(r"misra-c2012-(\d+\.\d+)", done.stderr))
        mandatory = {"9.1", "12.5", "13.6", "17.3", "17.4", "17.6", "19.1", "21.13", "21.17", "21.18", "21.19",
                     "21.20", "22.2", "22.4", "22.5", "22.6"}  # fmt: skip
        assert found and not found & mandatory, (name, found)
        assert "error:" not in done.stderr.replace("misra", ""), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("name", ["hopper", "argmax_of_outputs", "tanh_box", "labels", "sensor", "wide_sums"])
def test_the_same_integers_on_small_machines(name: str, target: str, tmp_path: Path) -> None:
    missing = TARGETS[target].missing()
    if missing:
        pytest.skip(f"{missing} is not installed (apt-get install {TARGETS[target].packages})")
    fixed = TREES[name]
    ran = run_on(TARGETS[target], fixed, N_STATES, tmp_path)
    assert ran.hash == answers_hash(fixed, N_STATES)
