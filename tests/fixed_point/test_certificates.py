"""What is proved of trees in fixed point holds at every state that is tried, and what is not so is refused."""

import subprocess
import sys
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import otr
from otr.clock import time_limit
from otr.fixed_point.leads import LeadChecker, certificate_of_leads
from otr.proof.exact_rows import TreeAndNetwork
from tests.core.strategies import boundary_states, cases, make_network

BOX = (-2.0, 2.0)


def states_of(network: otr.ReluNetwork, seed: int, n: int = 300) -> np.ndarray:
    rng = np.random.default_rng(seed)
    X = rng.uniform(*BOX, (n, network.n_inputs))
    corners = np.array(list(product(BOX, repeat=network.n_inputs)))
    return np.clip(np.concatenate((X, corners, boundary_states(network, X[:50], rng))), *BOX)


def lead(outputs: np.ndarray) -> np.ndarray:
    """Return by how much the largest output is above the others, or, of one output, how far it is from 0."""
    if outputs.shape[1] == 1:
        return np.abs(outputs[:, 0])
    ranked = np.sort(outputs, axis=1)
    return ranked[:, -1] - ranked[:, -2]


def assert_holds(fixed, network, proof, X):
    ours, theirs = fixed.predict(X), network.predict(X)
    if network.head.gives_labels:
        assert lead(network.forward(X))[ours != theirs].max(initial=-1) <= proof.max_error + 1e-9
    else:
        assert (np.abs(ours - theirs).max(axis=0, initial=0.0) <= np.array(proof.max_errors) + 1e-9).all()


@settings(max_examples=40)
@given(cases(max_layers=2), st.sampled_from((6, 10, 16)), st.booleans(), st.integers(0, 2**32 - 1))
def test_no_state_is_farther_from_the_network_than_is_proved(case, bits, of_tests, seed):
    network = case.network
    assume(not (network.head.gives_labels and network.n_outputs == 1 and isinstance(network.head, otr.Argmax)))
    tree = otr.map_network(network)
    if network.head.gives_labels and not of_tests:
        tree = tree.replace(labels=None)
    fixed = otr.to_fixed_point(tree, BOX, bits)
    proof = otr.certify_fixed_point(fixed, network, BOX)
    assert otr.verify(proof, fixed, network) == proof.max_error
    assert_holds(fixed, network, proof, states_of(network, seed))


@settings(max_examples=25)
@given(cases(max_layers=2), st.sampled_from((6, 10, 16)), st.integers(0, 2**32 - 1))
def test_away_from_its_tests_a_tree_is_as_near_as_is_proved(case, bits, seed):
    tree = otr.map_network(case.network)
    tree = tree.replace(M=tree.M + np.random.default_rng(seed).normal(size=tree.M.shape))  # it jumps
    fixed = otr.to_fixed_point(tree, BOX, bits)
    proof = otr.certify_fixed_point(fixed, tree, BOX)
    assert otr.verify(proof, fixed, tree) == proof.max_error
    X = states_of(case.network, seed)
    never = ~tree.test_forms.any(axis=1)  # tests that are 0 everywhere
    X = X[(np.abs(X @ tree.P.T + tree.v) > np.where(never, -1, proof.margins)).all(axis=1)]
    if tree.labels is not None:
        assert proof.max_error == 0
    assert_holds(fixed, tree, proof, X)


@pytest.mark.parametrize(("layers", "n_outputs", "seed"), [((), 3, 3), ((4,), 3, 24), ((3,), 1, 9)])
def test_no_output_leads_over_that_of_the_label_by_more_than_is_proved(layers, n_outputs, seed):
    rng, head = np.random.default_rng(seed), "argmax" if n_outputs > 1 else "sign"
    network = make_network(rng, layers, n_inputs=2, n_outputs=n_outputs, head=head)
    rounded = otr.to_fixed_point(otr.map_network(network), BOX, 5).to_tree()
    proof = certificate_of_leads(rounded, network, otr.Domain([BOX[0]] * 2, [BOX[1]] * 2), 0.1, 2**16)
    X = rng.uniform(*BOX, (50_000, 2))
    scores, labels = network.forward(X), rounded.predict(X)
    scores = np.column_stack((0 * scores, scores)) if n_outputs == 1 else scores
    seen = (scores.max(axis=1) - scores[np.arange(len(X)), labels]).max()
    assert 0 < seen <= proof.max_error < 2 * seen
    with pytest.raises(otr.TimeLimitError), time_limit(0.0, lambda: ""):
        certificate_of_leads(rounded, network, proof.domain, 0.1, 2**16)
    checker = LeadChecker(TreeAndNetwork(rounded, network, proof.domain))
    assert checker.run(proof) == proof.max_error
    with pytest.raises(otr.CertificateError, match="may differ by"):
        checker.run(replace(proof, max_error=0.99 * proof.max_error))
    cells = [replace(cell, outcomes=cell.outcomes.translate(str.maketrans("01", "10"))) for cell in proof.cells]
    with pytest.raises(otr.CertificateError, match="may differ by"):
        checker.run(replace(proof, cells=tuple(cells)))


@pytest.mark.parametrize(("n_outputs", "seed"), [(2, 0), (3, 4), (4, 3)])
def test_a_leaf_of_several_regions_of_the_network_takes_a_cell_for_each(n_outputs, seed):
    network = make_network(np.random.default_rng(seed), (6,), n_inputs=2, n_outputs=n_outputs, head="argmax")
    tree = otr.minimal_tree(network, BOX)
    fixed = otr.to_fixed_point(tree, BOX, 16)
    proof = otr.certify_fixed_point(fixed, network, BOX)
    assert otr.verify(proof, fixed, network) == proof.max_error < 0.01
    cells = proof.certificate.cells
    assert len(cells) > tree.n_leaves
    assert_holds(fixed, network, proof, states_of(network, seed))
    split = next(i for i, cell in enumerate(cells) if cell.splits)
    checker = LeadChecker(TreeAndNetwork(fixed.to_tree(), network, proof.certificate.domain))
    with pytest.raises(otr.CertificateError, match="its cells do not cover it"):
        checker.run(replace(proof.certificate, cells=cells[:split] + cells[split + 1 :]))
    with pytest.raises(otr.CertificateError, match="give more bits"):
        otr.certify_fixed_point(otr.to_fixed_point(tree, BOX, 5), network, BOX, max_error=1e-6)
    assert otr.shortest_fixed_point(tree, network, BOX, 0.01)[0].bits < 16


NETWORK = make_network(np.random.default_rng(3), (3,), n_inputs=3, head="clip_box")


def exhaustive(bits: int) -> tuple[float, float]:
    """Return the largest error at all integers of three inputs, and at what is rounded to them, and the bound."""
    half = 2 ** (bits - 1)
    box = (-np.ones(3), np.full(3, (half - 1) / half))
    fixed = otr.to_fixed_point(otr.minimal_tree(NETWORK, box), box, bits, input_scales=[1 / half] * 3)
    assert fixed.input_low.tolist() == [-half] * 3 and fixed.input_high.tolist() == [half - 1] * 3
    proof = otr.certify_fixed_point(fixed, NETWORK, box)
    word, seen, worst = np.arange(-half, half), 0.0, []
    for q in word:  # all integers, a plane at a time
        Q = np.column_stack([np.full(4**bits, q), np.repeat(word, 2 * half), np.tile(word, 2 * half)])
        answers, X = fixed.predict_integers(Q) * float(fixed.output_scales[0]), Q / half
        error = np.abs(answers - NETWORK.predict(X))[:, 0]
        worst.append(Q[error > 0.8 * error.max()])
    Q = np.concatenate(worst)
    answers = fixed.predict_integers(Q) * float(fixed.output_scales[0])
    for corner in product((-0.5, 0.0, 0.5), repeat=3):  # states that are rounded to these integers
        X = np.clip((Q + corner) / half, *box)
        seen = max(seen, float(np.abs(answers - NETWORK.predict(X)).max()))
    return seen, proof.max_error


@pytest.mark.parametrize("bits", [5, pytest.param(8, marks=pytest.mark.slow)])
def test_all_integers_of_three_inputs_are_within_the_bound_and_it_is_at_most_twice_what_is_seen(bits):
    seen, proved = exhaustive(bits)
    assert seen <= proved <= 2 * seen


def broken(fixed: otr.FixedPointTree) -> dict[str, otr.FixedPointTree]:
    M, shifts = fixed.M.copy(), fixed.shifts.copy()
    at = np.unravel_index(np.abs(fixed.M / 2.0 ** fixed.shifts[..., None]).argmax(), M.shape)
    M[at] -= np.sign(M[at])
    shifts[:, 0] += 1
    scales = (fixed.input_scales[0] * 2, *fixed.input_scales[1:])
    return {
        "coefficient": fixed.replace(M=M),
        "shift": fixed.replace(shifts=shifts),
        "scale": fixed.replace(input_scales=scales),
    }


@pytest.mark.parametrize("what", ["coefficient", "shift", "scale"])
def test_a_number_that_is_off_by_one_is_refused_with_a_state(what):
    net = otr.ReluNetwork([[[3.0]], [[1.0]]], [[-1.0], [0.25]], head=otr.ClipBox(-4, 4))
    fixed = otr.to_fixed_point(otr.minimal_tree(net, ([-1], [1])), ([-1], [1]), bits=6)
    proof = otr.certify_fixed_point(fixed, net, ([-1], [1]))
    changed = broken(fixed)[what]
    with pytest.raises(
        otr.CertificateError, match=r"of another FixedPointTree, and its claim fails at the state"
    ) as caught:
        otr.verify(proof, changed, net)
    x = [float(value) for value in caught.value.state]
    assert abs(changed.predict(x) - net.predict(x)).max() > proof.max_error


def test_a_smaller_claim_or_another_network_is_refused():
    tree = otr.minimal_tree(NETWORK, BOX)
    fixed = otr.to_fixed_point(tree, BOX, 12)
    proof = otr.certify_fixed_point(fixed, NETWORK, BOX)
    parts = proof.parts | {"inputs": (proof.parts["inputs"][0] / 2,)}
    claims = {"max_errors": (proof.max_error * 0.99,)}, {"parts": parts}
    for part in (*claims, {"certificate": replace(proof.certificate, max_error=0.0)}):
        with pytest.raises(otr.CertificateError, match=r"claims|leaf"):
            otr.verify(replace(proof, **part), fixed, NETWORK)
    with pytest.raises(otr.CertificateError, match="smaller box"):
        otr.verify(replace(proof, box=otr.Domain([-3] * 3, [3] * 3)), fixed, NETWORK)
    biases = [NETWORK.biases[0] + 0.1, NETWORK.biases[1]]
    with pytest.raises(otr.CertificateError, match="leaf"):
        otr.verify(proof, fixed, NETWORK.replace(biases=biases))


def test_a_smaller_error_is_searched_for(tmp_path):
    network = make_network(np.random.default_rng(2), (5,), n_inputs=2, head="clip_box")
    fixed = otr.to_fixed_point(otr.minimal_tree(network, BOX), BOX, 12)
    loose = otr.certify_fixed_point(fixed, network, BOX)
    asked = 0.8 * loose.certificate.max_error
    tight = otr.certify_fixed_point(fixed, network, BOX, max_error=asked)
    assert tight.certificate.max_error <= asked and tight.max_error < loose.max_error
    loaded = otr.load_certificate(tight.save(tmp_path / "certificate.json"))
    assert loaded == tight and otr.verify(loaded, fixed, network) == tight.max_error
    with pytest.raises(otr.CertificateError, match="at the state"):
        otr.certify_fixed_point(fixed, network, BOX, max_error=0.3 * loose.certificate.max_error)


def test_many_regions_in_a_leaf_leave_it_one_cell():
    rng = np.random.default_rng(0)
    network = otr.ReluNetwork(
        [rng.normal(size=(32, 6)), rng.normal(size=(2, 32))],
        [rng.normal(size=32), rng.normal(size=2)],
        head=otr.Argmax(),
    )
    tree = otr.parse_program("if x0 <= 0: 0 else: 1", [f"x{i}" for i in range(6)], labels=True, output_names=["0", "1"])
    tree = tree.replace(M=np.zeros((2, 2, 6)), c=np.eye(2))
    fixed = otr.to_fixed_point(tree, (-1, 1), 16)
    proof = otr.certify_fixed_point(fixed, network, (-1, 1))
    assert len(proof.certificate.cells) == 2 and proof.max_error > 1
    with pytest.raises(otr.CertificateError, match="give more bits or max_regions"):
        otr.certify_fixed_point(fixed, network, (-1, 1), max_error=0.1, max_regions=16)


@pytest.mark.parametrize("head", ["argmax", "clip_box"])
def test_a_damaged_certificate_is_refused_as_one(head):
    network = make_network(np.random.default_rng(0), (4,), n_inputs=2, n_outputs=2, head=head)
    fixed = otr.to_fixed_point(otr.map_network(network), BOX, 12)
    proof = otr.certify_fixed_point(fixed, network, BOX)
    inner, wide = proof.certificate, otr.Domain([-np.inf, -2], [np.inf, 2])
    damaged = [{"max_errors": ()}, {"box": wide}, {"box": otr.Domain([-2] * 3, [2] * 3)}]
    damaged += [{"certificate": replace(inner, **part)} for part in ({"max_error": np.inf}, {"max_error": np.nan})]
    damaged += [{"certificate": replace(inner, n_leaves=77)}, {"certificate": replace(inner, domain=wide)}]
    for part in damaged:
        with pytest.raises(otr.CertificateError):
            otr.verify(replace(proof, **part), fixed, network)


def test_a_new_process_checks_what_was_saved(tmp_path):
    tree = otr.map_network(make_network(np.random.default_rng(2), (3,), n_inputs=2, head="clip_box"))
    fixed = otr.to_fixed_point(tree, BOX, 12)
    otr.certify_fixed_point(fixed, tree, BOX).save(tmp_path / "proof.json")
    for saved, name in ((fixed, "fixed"), (tree, "tree")):
        otr.save(saved, tmp_path / name)
    code = "import otr; print(otr.verify(otr.load_certificate('proof.json'), otr.load('fixed'), otr.load('tree')))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and float(done.stdout) > 0, done.stderr


def test_words_of_inputs_have_the_lengths_with_which_the_least_is_proved():
    names = ["x", "y", "z", "a", "b", "c"]
    tree = otr.parse_program("100 x - y / 5 + z / 4 + a / 3 - b / 7 + c / 9", names).replace(head=otr.ClipBox(-1, 1))
    fixed, equal = (otr.to_fixed_point(tree, (-1, 1), input_scales=s) for s in (None, [1 / 32767] * 6))
    proved, of_equal = (otr.certify_fixed_point(each, tree, (-1, 1)).max_error for each in (fixed, equal))
    assert proved < 0.4 * of_equal
    assert fixed.input_high[0] == 32767 and (fixed.input_high < 4096).sum() >= 4


def test_an_input_that_hardly_varies_is_hardly_rounded():
    tree = otr.parse_program("1000 (x - 1)", ["x"])
    proof = otr.certify_fixed_point(otr.to_fixed_point(tree, ([1], [1 + 1e-7])), tree, ([1], [1 + 1e-7]))
    assert 1e-4 <= proof.parts["inputs"][0] < 2e-4


def test_the_shortest_words_are_those_that_are_proved_and_fewer_are_not():
    tree = otr.minimal_tree(NETWORK, BOX)
    fixed, proof = otr.shortest_fixed_point(tree, NETWORK, BOX, 0.01)
    assert proof.share <= 0.01 and otr.verify(proof, fixed, NETWORK) == proof.max_error
    assert otr.to_fixed_point(tree, BOX, None, max_error=0.01, network=NETWORK).bits == fixed.bits
    shorter = otr.to_fixed_point(tree, BOX, fixed.bits - 1)
    assert otr.certify_fixed_point(shorter, NETWORK, BOX).share > 0.01
    assert otr.to_fixed_point(tree, BOX, None, max_error=0.05, network=NETWORK).bits < fixed.bits
    with pytest.raises(otr.CertificateError, match="no words of 4 to 24 bits"):
        otr.to_fixed_point(tree, BOX, None, max_error=1e-12, network=NETWORK)
