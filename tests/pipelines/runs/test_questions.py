"""otr-verify answers questions: proved, with a state where it is otherwise, or undecided."""

import dataclasses
import functools
import re

import numpy as np
import pytest

import otr
from pipelines.play.actor_files import load_actor
from pipelines.runs.questions import always, bound_text, labels_but
from tests.committed import RESULTS, committed_tree
from tests.pipelines.conftest import PENDULUM

PENDULUM_RUN, CAR = "run=pendulum/otr/depth-6/quick/seed-0", "env=mountaincar"
BOX = otr.Domain(np.array([-1.0, -1.0, -8.0]), np.array([1.0, 1.0, 8.0]))
NAMES = [*PENDULUM.feature_names, "torque"]
PROGRAM = """if angle_rate > 2 and cos_angle > 0.5 then
    return clip(-sin_angle - 0.125 angle_rate, -2, 2)
else
    return clip(1.5 sin_angle, -2, 2)
"""


@pytest.fixture
def verify(command, monkeypatch):
    """Return what asks about a committed run."""
    monkeypatch.setenv("OTR_RESULTS_DIR", str(RESULTS))
    return functools.partial(command, "verify")


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        ("torque <= 1.5", True),
        ("torque < 1.5", False),  # it is 1.5 where sin_angle is 1
        ("abs(torque) <= 2", True),
        ("-2 < torque < 2", False),
        ("torque < 0 or angle_rate <= 2 or cos_angle <= 0.5 or sin_angle < 0", True),
        ("torque < 0 or angle_rate <= 2 or cos_angle <= 0.5 or sin_angle < -0.5", False),
        ("angle_rate <= 8", True),
        ("cos_angle + sin_angle <= 2", True),
        ("cos_angle + sin_angle < 2", False),
        ("not (torque > 1 and angle_rate > 2 and cos_angle > 0.75)", True),
    ],
)
def test_conditions_on_actions(condition, holds):
    tree = otr.parse_program(PROGRAM, PENDULUM.feature_names)
    answer = always(tree, condition, PENDULUM, BOX)
    assert answer.holds is holds, answer.text
    if not holds:
        state = [float(re.search(rf"{name} = (\S+?),? ", answer.text + " ")[1]) for name in PENDULUM.feature_names]
        holds_there = otr.parse_program(f"if {condition} then 1 else 0", NAMES, labels=True)
        assert holds_there.predict([*state, tree.predict(state)[0]]) == 0
        assert f"torque = {tree.predict(state)[0]}" in answer.text


def test_what_two_comparisons_exclude_only_together_is_undecided():
    tree = otr.parse_program("if cos_angle + sin_angle > 0 then 2 else -1", PENDULUM.feature_names)
    assert always(tree, "torque < 0 or cos_angle + sin_angle > 0", PENDULUM, BOX).holds
    answer = always(tree, "torque < 0 or torque > 1", PENDULUM, BOX)
    assert answer.holds is None
    assert answer.text.endswith("was found where -1 torque +0 <= 0 and -1 torque +1 > 0") or answer.text.endswith(
        "was found where -1 torque +0 <= 0 and +1 torque -1 <= 0"
    )


def test_labels_by_name(verify):
    run = "run=lunarlander/otr/depth-2/thesis/seed-0"
    assert "reached: none, left_engine, main_engine, right_engine" in verify(run, "range=true").stdout
    done = verify(run, "always=action != main_engine or y < 100")
    assert done.returncode == 0 and done.stdout.startswith("proved: action != main_engine or y < 100"), done.stderr
    done = verify(run, "always=action != main_engine")
    assert done.returncode == 1 and "with action = main_engine" in done.stdout


def test_a_run_and_a_program_are_asked(verify, tmp_path):
    done = verify(PENDULUM_RUN, "range=true", "always=torque <= 2")
    assert done.returncode == 0 and done.stdout.startswith("torque: -2 to 1.99997\nproved: torque <= 2\n"), done.stderr
    assert "asked of the pruned tree, at every real point of the environment's box of states" in done.stdout
    assert " ".join(done.stdout.split()).endswith(
        "; ranges to the rounding of a linear program; conditions to 1e-6 under tanh"
    )
    done = verify(PENDULUM_RUN, "tree=minimal", "always=torque <= 1.5")
    assert done.returncode == 1 and "fails: torque <= 1.5, at cos_angle = " in done.stdout
    assert verify(CAR, "program=mountaincar", "range=true").stdout.startswith("force: -1 to 1\n")


def test_a_program_is_compared_with_network_and_tree(verify, command, tmp_path):
    exact, short = tmp_path / "exact.txt", tmp_path / "short.txt"
    for path, precision in ((exact, 17), (short, 4)):
        done = command("export", PENDULUM_RUN, "format=text", "tree=minimal", f"precision={precision}", f"out={path}")
        assert done.returncode == 0, done.stderr
    assert verify(PENDULUM_RUN, f"program={exact}").stdout.startswith("proved: the program and the network are equal")
    assert "the program and the tree are equal" in verify(PENDULUM_RUN, f"program={exact}", "tree=minimal").stdout
    done = verify(PENDULUM_RUN, f"program={short}")
    assert done.returncode == 1 and done.stdout.startswith("differ: at cos_angle = "), done.stderr
    done = verify(PENDULUM_RUN, f"program={short}", "max_difference=0.5")
    assert done.returncode == 0 and "differ by at most 0.00" in done.stdout, done.stdout + done.stderr
    otr.save(otr.parse_program(PROGRAM, PENDULUM.feature_names), tmp_path / "tree")
    own = tmp_path / "own.txt"
    own.write_text(PROGRAM)
    assert verify("env=pendulum", f"program={own}", f"tree={tmp_path}/tree").returncode == 0
    done = verify(PENDULUM_RUN, f"program={own}")
    assert done.returncode == 2 and "cannot be compared: the tree has (inputs, outputs, head)" in done.stderr
    assert "The answers of the network are a tanh: write those of the program as return 2 tanh(...)" in done.stderr


def test_a_certificate_of_integers_is_checked(verify, tmp_path):
    net = load_actor(RESULTS / "runs" / PENDULUM_RUN.removeprefix("run=") / "train")
    for name, policy in (("network", net), ("tree", committed_tree(PENDULUM_RUN.removeprefix("run=")))):
        tree = otr.minimal_tree(net, BOX) if policy is net else policy
        fixed = otr.to_fixed_point(tree, BOX, bits=12)
        saved, proof = otr.save(fixed, tmp_path / name), otr.certify_fixed_point(fixed, policy, BOX)
        done = verify(PENDULUM_RUN, f"certificate={proof.save(tmp_path / 'proof.json')}", f"tree={saved}")
        assert done.stdout.startswith("verified: on the box cos_angle"), done.stdout + done.stderr
        assert f"the {'network' if policy is net else 'pruned tree'}" in done.stdout
    otr.save(fixed.replace(shifts=fixed.shifts + 2), tmp_path / "tree")
    done = verify(PENDULUM_RUN, f"certificate={tmp_path / 'proof.json'}", f"tree={saved}")
    assert done.returncode != 0 and "its claim fails at the state" in done.stderr


def test_after_a_polish_the_polished_network_is_the_runs(verify, command, tmp_path):
    run, paths = "run=lunarlander/otr/depth-2/thesis/seed-0", {}  # its certificate is of the polished network
    for tree in ("minimal", "pruned"):
        paths[tree] = tmp_path / f"{tree}.txt"
        command("export", run, "format=text", f"tree={tree}", "precision=17", f"out={paths[tree]}")
    done = verify(run, f"program={paths['minimal']}")
    assert done.stdout.startswith("proved: the program and the polished network"), done.stdout + done.stderr
    done = verify(run, f"program={paths['pruned']}")
    assert done.returncode == 1 and "the polished network action = " in done.stdout
    assert verify(run, f"program={paths['pruned']}", "tree=compact").stdout.count("the polished") == 0
    assert "of the pruned tree, not of the polished one (tree=polished), at" in verify(run, "range=true").stdout
    done = verify(run, f"program={paths['minimal']}", "max_difference=5")
    assert done.returncode == 2 and "max_difference=5: the answers are labels, which are equal or not" in done.stderr
    run = "run=pendulum/otr/depth-6/standard-fleet/seed-0"  # which has no certificate
    command("export", run, "format=text", "precision=17", f"out={paths['pruned']}")
    done = verify(run, f"program={paths['pruned']}", "max_difference=20")
    assert done.stdout.startswith("proved: the program and the polished network differ by at most "), done.stdout


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            (PENDULUM_RUN, "always=torqu <= 1"),
            "always: unknown name 'torqu'. Did you mean torque?\n    torqu <= 1\n    ^",
        ),
        ((PENDULUM_RUN, "always="), "always=: which condition? Such as"),
        ((PENDULUM_RUN, "always=torque"), "this is a number where a condition was expected"),
        ((PENDULUM_RUN, "range=perhaps"), "range=perhaps: give true or false"),
        (("env=mountaincar", "program=mountaincar"), "what is asked? Add run=FOLDER or tree=FILE"),
        ((PENDULUM_RUN, "tree=compact", "range=true"), "tree=compact: it is not held as leaves"),
        ((PENDULUM_RUN, "tree=prunde", "range=true"), "Did you mean pruned?"),
        (("always=x > 0",), "which run? Add run=FOLDER"),
    ],
)
def test_what_cannot_be_answered_is_told(verify, words, told):
    done = verify(*words)
    assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr, done.stderr


def test_bounds_are_told_rounded_up():
    assert [bound_text(bound) for bound in (1.01e-13, 2e-9, 0.0)] == ["2e-13", "2e-9", "0"]
    assert bound_text(0.12301, 3) == "0.124"
    assert labels_but(1.01e-13) == "within 2e-13 of a boundary" and labels_but(5e-324) == "on a boundary between two"


CART_POLE = """if 0.5 th + w > 0 then push else pull
"""


def test_a_program_under_the_users_names_on_the_users_box(command, tmp_path):
    (tmp_path / "cart.txt").write_text(CART_POLE)
    words = ("env=CartPole-v1", f"program={tmp_path / 'cart.txt'}", "env.feature_names=[x,v,th,w]")
    words = (*words, "env.action_names=[pull,push]")
    written = command("export", *words, "format=text")
    assert written.stdout == "if 0.5 th + w <= 0 then\n    return pull\nelse\n    return push\n", written.stderr
    reached = command("verify", *words, "range=true")
    assert reached.returncode == 0 and reached.stdout.startswith("reached: pull, push"), reached.stderr
    assert "the box around the states that it visits in a few episodes (box= asks of another), x in " in reached.stdout
    box = "box=[th in 0.1..0.2, v in -1..1, w in 0..1]"
    done = command("verify", *words, box, "range=true", "always=action == push")
    assert done.returncode == 0 and "never: pull\nproved: action == push\nasked" in done.stdout, done.stderr
    assert "every real point of the given box, x in -4.8..4.8, v in -1..1, th in 0.1..0.2, w in 0..1" in done.stdout
    lacking = command("verify", *words, "box=[th in 0.1..0.2]", "range=true")
    assert lacking.returncode == 2 and "add v in LOW..HIGH, w in LOW..HIGH" in lacking.stderr
    refused = command("verify", PENDULUM_RUN, "env.feature_names=[a,b,c]", f"results_dir={RESULTS}", "range=true")
    assert refused.returncode == 2 and "a run has its own environment" in refused.stderr
    alone = command("verify", PENDULUM_RUN, box, f"results_dir={RESULTS}")
    assert alone.returncode == 2 and "a certificate is of the box that it was made for" in alone.stderr


@pytest.mark.parametrize(
    ("condition", "is_vacuous"),
    [
        ("torque <= 1.5", False),
        ("torque <= 2", True),  # the clip's own limits
        ("torque <= 1.5 or angle_rate <= 8", True),  # no state is above
        ("torque <= 1.5 or angle_rate <= 7", False),
        ("angle_rate <= 8", True),
        ("not (torque > 1.5 and cos_angle + sin_angle > 2)", True),
    ],
)
def test_what_any_policy_keeps_is_said_to_say_nothing(condition, is_vacuous):
    answer = always(otr.parse_program(PROGRAM, PENDULUM.feature_names), condition, PENDULUM, BOX)
    assert answer.holds and ("says nothing about the policy" in answer.text) is is_vacuous


@pytest.mark.parametrize(("condition", "is_vacuous"), [("action != 2", False), ("action == 1 or w <= 1", True)])
def test_labels_that_any_policy_may_choose(condition, is_vacuous):
    tree = otr.parse_program("if w > 0 then 1 else 0", ["w"], labels=True, output_names=["a", "b", "c"])
    env = dataclasses.replace(PENDULUM, feature_names=["w"], action_names=["a", "b", "c"])
    answer = always(tree, condition, env, otr.Domain([-1.0], [1.0]))
    assert answer.holds and ("says nothing about the policy" in answer.text) is is_vacuous
