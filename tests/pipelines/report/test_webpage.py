"""The page of finished runs: what stands in the file, down to the bits of the tree. A browser reads it in test-all."""

import base64
import dataclasses
import gzip
import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import otr
from otr.shorten.edits import n_numbers
from pipelines.cli.runs import load_config
from pipelines.engine.seeding import episode_seeds
from pipelines.engine.store import read_csv
from pipelines.errors import MissingInputError, PipelineError
from pipelines.play.episodes import play_seeds
from pipelines.report.cells import TASK_NAMES
from pipelines.report.frames import load_runs
from pipelines.report.webpage import page as webpage
from pipelines.report.webpage.episode import LEVELS, packed, record
from pipelines.report.webpage.gallery import readable_trees, write_gallery
from pipelines.report.webpage.page import write_results_page, write_run_page
from pipelines.report.webpage.physical_units import unit_of
from pipelines.report.webpage.policy import _rounds_unseen, page_tree, tree_data
from pipelines.report.webpage.verdict import Returns, _lead, _proved, best_known, proof
from pipelines.runs.below_random import random_returns
from pipelines.runs.finished_run import tree_of
from tests.committed import RESULTS
from tests.core.test_tree import random_tree
from tests.pipelines.conftest import HOPPER, PENDULUM, otr_command, otr_succeeds

CAR, LANDER, PID = (
    RESULTS / "runs" / run
    for run in (
        "mountaincar/otr/depth-1/quick/seed-0",
        "lunarlander/augtree/depth-2/quick/seed-0",
        "pendulum/pid/depth-1/quick/seed-0",
    )
)


def config_of(run_dir: Path) -> Any:
    return load_config(run_dir, 1)


def stored(page: str, kind: str = "policy") -> list[dict[str, Any]]:
    blocks = re.findall(rf'<script type="text/plain" class="{kind}" id="[\w-]+">([^<]*)</script>', page)
    return [json.loads(gzip.decompress(base64.b64decode(block))) for block in blocks]


def unpacked(data: dict[str, Any]) -> NDArray[Any]:
    return np.frombuffer(base64.b64decode(data["data"]), "<" + data["dtype"]).reshape(data["shape"])


def results_of(folder: Path, *runs: Path, name: str | None = None) -> Path:
    """Return a folder of results with links to runs, as they are named or under another name."""
    for run in runs:
        place = folder / "runs" / (name or run.relative_to(RESULTS / "runs"))
        place.parent.mkdir(parents=True)
        place.symlink_to(run)
    return folder


def page_of_results(folder: Path) -> str:
    return write_results_page(folder, folder / "page.html", config_of).read_text(encoding="utf-8")


def page_of_runs(folder: Path, *runs: Path, form: str | None = None, config: Callable[..., Any] = config_of) -> str:
    return write_run_page([*runs], form, folder / "page.html", config).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> str:
    return page_of_runs(tmp_path_factory.mktemp("page"), CAR)


def test_the_page_holds_the_tree_bit_for_bit_its_program_and_its_proof(car: str) -> None:
    (data,) = stored(car)
    tree, held = page_tree(config_of(CAR), CAR, "pruned"), data["tree"]
    for name, array in (("left", tree.children_left), ("right", tree.children_right), ("P", tree.P), ("v", tree.v),
                        ("M", tree.M), ("c", tree.c)):  # fmt: skip
        np.testing.assert_array_equal(unpacked(held[name]), array)
    assert held["head"]["name"] == tree.head.name and held["labels"] is None and len(held["colours"]) == tree.n_leaves
    shares = unpacked(held["shares"])
    assert shares.sum() == pytest.approx(1.0) and (shares[unpacked(data["episode"]["leaves"])] > 0).all()
    assert [feature["name"] for feature in data["features"]] == ["position", "velocity"]
    assert (data["features"][0]["low"], data["features"][0]["high"]) == pytest.approx((-1.2, 0.6))
    assert "double" in data["exports"]["C"] and "def " in data["exports"]["Python"] and not data["left_out"]
    assert data["answers"] == ["force"] and data["texts"][1][1].startswith("if ")
    proved = data["verdict"]["proof"]
    assert proved.startswith("certificate: the minimal tree, of ")
    assert proved.endswith("otr-verify checks it again. The tree below is the pruned one.")
    for array in (np.array([[0.1, -1e300], [5e-324, 3.0]]), np.array([-5, 7], np.int32), np.array([], np.uint16)):
        np.testing.assert_array_equal(unpacked(packed(array)), array)
        assert unpacked(packed(array)).dtype == array.dtype
    tree, X = random_tree(np.random.default_rng(0), 9, 2, 1, 8), np.random.default_rng(1).normal(size=(50, 2))
    shares = np.bincount(tree.apply(X), minlength=tree.n_leaves) / 50
    np.testing.assert_allclose(unpacked(tree_data(tree, X)["shares"]), shares, atol=1e-7)


def test_the_episode_is_the_first_one_evaluated(car: str) -> None:
    (data,) = stored(car)
    (first, *_) = read_csv(CAR / "evaluate" / "episodes_pruned_tree.csv")
    episode, tree = data["episode"], page_tree(config_of(CAR), CAR, "pruned")
    assert episode["return"] == pytest.approx(float(first["return"]), abs=1e-9)
    assert episode["n_steps"] == int(first["length"]) and episode["seed"] == 1000
    states = play_seeds(tree.predict, config_of(CAR).env, [1000], keep_states=True, n_workers=1).states
    states = states[:: episode["stride"]]
    low, high = np.array(episode["low"]), np.array(episode["high"])
    shown = low + unpacked(episode["states"]) / LEVELS * (high - low)
    np.testing.assert_allclose(shown, states, atol=float((high - low).max()) / LEVELS)
    np.testing.assert_array_equal(unpacked(episode["leaves"]), tree.apply(states))
    np.testing.assert_array_equal(unpacked(episode["answers"]), tree.predict(states).astype(np.float32))
    sprite = Image.open(io.BytesIO(base64.b64decode(episode["sprite"])))
    rows = -(-episode["n_frames"] // episode["frame_columns"])
    assert sprite.size == (episode["frame_width"] * episode["frame_columns"], episode["frame_height"] * rows)
    assert np.asarray(sprite).std() > 10  # there is something in the pictures


def test_what_matters_stands_on_the_page(car: str) -> None:
    (data,) = stored(car)
    (outputs,), decisions = data["importance"]["outputs"], data["importance"]["decisions"]
    assert data["outputs"] == ["force"] and data["tree"]["head"]["words"] == "tanh, scaled to -1 .. 1"
    assert sum(decisions) == pytest.approx(1.0, abs=1e-3) and decisions[1] > 0.9  # the velocity
    tree = page_tree(config_of(CAR), CAR, "pruned")
    weights = np.tensordot(unpacked(data["tree"]["shares"]), np.abs(tree.M), axes=1)[0]
    deviations = np.array(outputs) / weights
    ranges = [each["high"] - each["low"] for each in data["features"]]
    assert (deviations > 0).all() and (deviations < ranges).all()


def test_the_page_leads_with_what_the_policy_returns_compared_with_others(car: str, tmp_path: Path) -> None:
    (data,) = stored(car)
    summary, verdict = json.loads((CAR / "summary.json").read_text()), data["verdict"]
    known = best_known(RESULTS, "mountaincar")
    assert verdict["lead"].startswith("Returns 92.45 ± 0.15 over 1,000 episodes. That is lower than the best linear")
    rows = {row[0]: row[1:] for row in verdict["rows"]}
    assert rows["this tree (pruned)"] == ["2 leaves, 8 numbers", "92.45 ± 0.15"]
    assert rows["the network"][1] == "92.45 ± 0.15" and verdict["lead"].endswith(
        "two policies compared, not their methods."
    )
    assert rows["a linear policy"][1] == str(known["linear"]) == "97.83 ± 6.24"
    assert rows["an oracle"][0].startswith("the best of 3 known: a network of one layer of 32, budget quick, seed ")
    assert rows["a linear policy"][0] == "the best of 10 known: Linear, budget standard, seed 0"
    assert known["linear"].mean == max(
        json.loads(path.read_text())["policies"]["pruned_tree"]["return_mean"]
        for path in RESULTS.glob("runs/mountaincar/*/depth-0/*/seed-*/summary.json")
    )
    assert f"{summary['fidelity']:.2%}".replace("%", " %") in verdict["lines"][0]
    (first, _), (second, _) = data["texts"]  # the shorter one first
    assert first == "simplified tree: 1 leaf, 1 number, returns 91.34 ± 1.29" and second.startswith("pruned tree: 2 l")
    alone = stored(page_of_results(results_of(tmp_path, CAR)))[0]["verdict"]
    assert [row[2] for row in alone["rows"]][-2:] == ["not run", "not run"] and alone["proved"].endswith(", 2 leaves")
    assert alone["lead"] == "Returns 92.45 ± 0.15 over 1,000 episodes."


@pytest.mark.parametrize(("mean", "says"), [(50.0, "is lower"), (59.9, "does not differ"), (70.0, "is higher")])
def test_a_difference_is_one_where_it_is_significant(mean: float, says: str) -> None:
    linear = Returns(60.0, 10.0, 100)
    assert f"That {says}" in _lead(Returns(mean, 10.0, 100), linear)


def test_the_gallery_chooses_by_its_rule_and_has_a_page_each(tmp_path: Path) -> None:
    runs = load_runs(RESULTS)
    chosen = readable_trees(runs, RESULTS).set_index("task")
    assert [*chosen.index] == [*TASK_NAMES] and chosen["leaves"].between(2, 64).all()
    assert (chosen["numbers"] <= 4000).all() and not {"pid", "program"} & {*chosen["method"]}
    of_pendulum = runs[(runs["env"] == "pendulum") & (runs["form"] == "simplified")]
    assert chosen.loc["pendulum", "numbers"] == of_pendulum["simplify.n_numbers"].min() == 22
    assert chosen.loc["mountaincar", "numbers"] == 8  # of as many leaves as one that returns more
    known = runs[(runs["form"] == "pruned_tree") & runs["pruned_leaves"].between(2, 64) & (runs["settings"] == "")]
    for row in known[known["env"] == "ant"].itertuples():
        tree, random, folder = chosen.loc[row.task], random_returns()[str(row.task)], RESULTS / "runs" / row.run
        numbers = n_numbers(tree_of("pruned", config_of(folder), folder))
        assert tree["return_mean"] >= random + 0.95 * (row.return_mean - random) or numbers > 4000
        assert numbers >= tree["numbers"] or row.return_mean < tree["return_mean"]
    index = write_gallery(results_of(tmp_path, CAR, LANDER), tmp_path / "gallery", config_of).read_text()
    assert re.findall(r'<a href="([^"]+)" target=_top', index) == ["mountaincar.html", "lunarlander.html"]
    page = (tmp_path / "gallery/lunarlander.html").read_text()
    (policy,) = stored(page)
    assert policy["form"] == "polished" and policy["folder"] == "" and '<a href="index.html">' in page
    moving = Image.open(tmp_path / "gallery/mountaincar.webp")
    assert moving.is_animated and moving.n_frames > 5  # type: ignore[attr-defined]
    with pytest.raises(MissingInputError, match="no run there has a tree that tests and is short"):
        write_gallery(tmp_path / "nowhere", tmp_path / "none", config_of)


def test_labels_that_the_head_decides_are_decided_by_tests_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    tree = random_tree(rng, 5, 2, 3, 4).replace(head=otr.Argmax())
    monkeypatch.setattr("pipelines.report.webpage.policy.tree_of", lambda form, run, folder: tree)
    shown, X = page_tree(config_of(CAR), CAR, "pruned"), rng.normal(size=(200, 2))
    assert shown.labels is not None
    np.testing.assert_array_equal(shown.predict(X), tree.predict(X))


def test_the_page_needs_no_network_and_its_scripts_are_whole(car: str) -> None:
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", car)
    assert "fetch(" not in car and "import(" not in car and "XMLHttpRequest" not in car
    assert car.count("<script") == car.count("</script>") == 2  # the policy, and the scripts
    assert "$" + "title" not in car and "<title>mountaincar/otr/depth-1/quick/seed-0</title>" in car


def test_a_proof_of_the_network_before_a_polish_says_so() -> None:
    proved = {"certified": True, "max_error": 1e-9, "n_leaves": 2, "domain": "a box", "seconds": {}}
    for labels, policy, like in (
        ({}, {"policy": "polished"}, "the polished network to 1e-9"),
        ({"labels": True}, {}, "the network, but perhaps within 1e-9 of a boundary,"),
    ):
        said = proof({"polish": {}, "certify": proved | labels | policy}, "polished")
        assert f"is {like} on a box" in said
        assert ("It is of the network before the polish. The tree below is the polished one." in said) == (not policy)


@pytest.mark.parametrize(
    ("form", "kept", "of", "says"),
    [
        ("pruned", False, None, "its network's tree, 30 leaves"),
        ("polished", True, "polished", "its network's tree, 30 leaves"),
        ("pruned", True, "polished", "no"),  # the network that is proved is another one
        ("polished", True, None, "no"),
        ("simplified", False, None, "no"),
    ],
)
def test_the_list_says_what_is_proved_of_the_tree_that_is_shown(
    form: str, kept: bool, of: str | None, says: str
) -> None:
    summary = {
        "certify": {"certified": True, "n_leaves": 30} | ({"policy": of} if of else {}),
        "polish": {"kept": kept},
    }
    assert _proved(summary, form) == says and _proved(summary | {"certify": {"certified": False}}, form) == "no"


def test_a_shorter_program_has_its_distance_from_the_tree_that_stands_behind_it(tmp_path: Path) -> None:
    run = RESULTS / "runs/pendulum/otr/depth-6/quick/seed-0"
    (data,) = stored(page_of_runs(tmp_path, run, form="simplified"))
    (shorter, _), (whole, _) = data["texts"]
    assert shorter.startswith("simplified tree: 4 leaves, 22 n") and whole.startswith("pruned tree: 20 leaves, 175 n")
    config, (line,) = config_of(run), data["verdict"]["lines"]
    short, full = (page_tree(config, run, form) for form in ("simplified", "pruned"))
    seeds = [*episode_seeds(config.seed, "prune", 2), 1000]
    X = play_seeds(short.predict, config.env, seeds, keep_states=True, n_workers=1).states
    apart = 100 * np.abs(short.predict(X) - full.predict(X)) / 4  # torques are -2 to 2
    assert f"by {apart.mean():.1f} % of their range on average and {apart.max():.1f} % at most, on 600 states" in line
    assert data["verdict"]["proof"].endswith("a simplified one, another policy, of which nothing is proved.")


def test_names_are_names_whatever_is_in_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    evil = "</script><img src=x onerror=alert(1)>"
    monkeypatch.setattr("pipelines.report.webpage.policy.feature_names", lambda env, n: [evil, "$style"])
    monkeypatch.setattr("pipelines.report.webpage.policy.action_names", lambda env, n: ["<b>force"])

    def named(run_dir: Path) -> Any:
        config = config_of(run_dir)
        return dataclasses.replace(config, env=dataclasses.replace(config.env, name=evil))

    page = page_of_runs(tmp_path, CAR, config=named)
    assert evil not in page and page.count("</script>") == 2
    (data,) = stored(page)
    assert [feature["name"] for feature in data["features"]] == [evil, "$style"] and data["answers"] == ["<b>force"]


def test_several_runs_are_chosen_from_a_list_and_terms_of_pid_have_ranges(tmp_path: Path) -> None:
    page = page_of_runs(tmp_path, LANDER, PID)
    lander, pid = stored(page)
    assert lander["tree"]["labels"] and lander["limits"] is None and "M" not in lander["tree"]
    assert page.count('<a href="#view"') == 2 and 'data-policy="policy-1">pid, depth 1, seed 0</a>' in page
    value, text = lander["verdict"]["return"]
    assert f'<td data-name=Return data-value="{value}">{text}</td>' in page
    assert len(pid["features"]) == 12 and all(feature["low"] < feature["high"] for feature in pid["features"])
    assert pid["tree"]["head"]["name"] == "pid_box"


def test_a_long_episode_is_thinned_and_one_without_pictures_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    tree = page_tree(config_of(LANDER), LANDER, "pruned")

    def no_screen(env: Any, width: int) -> None:
        raise PipelineError("video: it cannot be rendered here (no screen). MuJoCo needs a screen")

    monkeypatch.setattr("pipelines.report.webpage.episode.renderable", no_screen)
    env = config_of(LANDER).env
    (length,) = play_seeds(tree.predict, env, [1000], n_workers=1).lengths.tolist()
    episode = record(tree, env, 1000, length=length, n_frames=5, width=32, most_steps=50)
    assert len(unpacked(episode["states"])) == len(unpacked(episode["leaves"])) and episode["n_steps"] == length
    assert episode["stride"] == -(-episode["n_steps"] // 50) > 1
    assert unpacked(episode["leaves"]).shape == (-(-episode["n_steps"] // episode["stride"]),)
    assert episode["no_frames"] == "video: it cannot be rendered here (no screen)." and "sprite" not in episode


def test_a_tree_that_is_too_large_names_the_command_that_makes_its_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The car's tree has 14 numbers; the lander's four leaves are labels, and its three tests have 27.
    monkeypatch.setattr(webpage, "OF_MANY", dataclasses.replace(webpage.OF_MANY, tree_bytes=4 * 20, n_frames=0))
    page = page_of_results(results_of(tmp_path, CAR, LANDER))
    (policy,) = stored(page)
    assert policy["env"] == "mountaincar" and 'data-policy="' not in page  # the lander's cell opens nothing
    line, of_polished = re.findall(r"<li>([^<]*)</li>", page)
    command = f"otr-report run={LANDER.relative_to(RESULTS / 'runs').as_posix()} tree=pruned results_dir={tmp_path}"
    assert line.startswith("LunarLander, AugTree (2), budget quick, seed 0") and f"; {command} writes its page" in line
    assert "tree=polished" in of_polished


def test_a_policy_is_there_once_and_all_are_shown_where_no_run_is_in_the_tables(tmp_path: Path) -> None:
    twice = RESULTS / "runs/mountaincar/otr/depth-1/standard-ars/seed-0"  # its polish was not kept
    assert not json.loads((twice / "summary.json").read_text())["polish"]["kept"]
    (policy,) = stored(page_of_results(results_of(tmp_path / "a", twice)))
    assert policy["form"] == "pruned"
    page = page_of_results(results_of(tmp_path / "b", CAR, name="mountaincar/otr/depth-1/quick/seed-0~0a1b2c3d"))
    (policy,) = stored(page)
    assert policy["env"] == "mountaincar" and 'id="table-4-1"' not in page


def test_numbers_are_rounded_where_no_visited_state_tells(tmp_path: Path) -> None:
    page = page_of_runs(tmp_path, CAR, LANDER, form="pruned")
    for data, folder in zip(stored(page), (CAR, LANDER), strict=True):
        tree = page_tree(config_of(folder), folder, "pruned")
        assert unpacked(data["tree"]["P"]).dtype == np.float32
        np.testing.assert_array_equal(unpacked(data["tree"]["P"]), tree.P.astype(np.float32))
    X = np.random.default_rng(0).normal(size=(50, 2))
    tree = random_tree(np.random.default_rng(0), 9, 2, 1, 8)
    assert _rounds_unseen(tree, X)
    times = tree.replace(P=tree.P, v=tree.v - tree.P @ [1.7e9, 0.0])  # the same, of seconds since 1970
    assert not _rounds_unseen(times, X + np.array([1.7e9, 0.0]))
    assert not _rounds_unseen(tree.replace(v=tree.v + 1e300), X)


def test_the_page_of_all_results_has_the_tables_and_a_policy_a_cell(tmp_path: Path) -> None:
    linear = RESULTS / "runs/pendulum/linear/depth-0/quick/seed-0"
    page = page_of_results(results_of(tmp_path, CAR, LANDER, linear))
    policies = stored(page)
    links = set(re.findall(r'data-policy="([^"]+)"', page))
    assert links and links <= set(re.findall(r'class="policy" id="([^"]+)"', page))
    assert {data["env"] for data in policies} >= {"mountaincar", "pendulum"}
    assert 'id="table-4-1"' in page and "not run" in page and "thesis -138.3" in page
    assert "<td>oracle</td>" in page and " of [256]</td>" in page  # that the lander's tree imitates
    assert 'id="table-4-2"' not in page  # there is no fit
    (figures,) = stored(page, "figures")
    assert set(figures) == {"curves", "leaves", "seconds"}
    (line,) = figures["seconds"]["MountainCar"]["series"]
    summary = json.loads((CAR / "summary.json").read_text())
    assert line["points"] == [[pytest.approx(summary["seconds"]["train"], rel=1e-5),
                               pytest.approx(summary["return_mean"], rel=1e-4)]]  # fmt: skip


def test_runs_that_differ_in_other_settings_are_told_apart(tmp_path: Path) -> None:
    name = "mountaincar/otr/depth-1/quick/seed-0~0a1b2c3d"
    page = page_of_runs(tmp_path, CAR, results_of(tmp_path, CAR, name=name) / "runs" / name)
    names = re.findall(r"data-policy=[^>]*>([^<]*)</a>", page)
    assert names == ["otr, depth 1, seed 0", "otr, depth 1, seed 0 ~0a1b2c3d"]
    assert names[1] in stored(page)[1]["about"]


def test_a_return_beside_a_pruned_tree_is_its_own(tmp_path: Path) -> None:
    run = tmp_path / "results/runs/mountaincar/otr/depth-1/quick/seed-0"
    run.mkdir(parents=True)
    for file in CAR.iterdir():
        (run / file.name).symlink_to(file)
    (run / "summary.json").unlink()
    summary = json.loads((CAR / "summary.json").read_text())
    summary["policies"]["pruned_tree"]["return_mean"] = 12.34
    (run / "summary.json").write_text(json.dumps(summary))
    page = page_of_results(tmp_path / "results")
    (policy,) = stored(page)
    assert policy["verdict"]["return"][0] == 12.34 and "Returns 12.34 ± " in policy["verdict"]["lead"]
    assert policy["export_command"].endswith(f"tree=pruned format=NAME results_dir={tmp_path}/results")
    (figures,) = stored(page, "figures")
    (line,) = figures["leaves"]["MountainCar"]["series"]
    assert line["points"] == [[summary["pruned_leaves"], 12.34]]


def test_what_cannot_be_shown_is_named_and_the_rest_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import pipelines.report.webpage.policy as policy

    real: Callable[..., Any] = policy.tree_of
    assert unit_of(PENDULUM, "angle_rate") == "rad/s" and unit_of(PENDULUM, "cos_angle") == ""
    assert unit_of(HOPPER, "x_velocity") == "m/s" and unit_of(HOPPER, "thigh_angle") == "rad"
    assert unit_of(dataclasses.replace(HOPPER, id="My-v0"), "x_velocity") == ""
    monkeypatch.setattr(policy, "tree_of", lambda *asked: object() if asked[2] == CAR else real(*asked))
    page = page_of_runs(tmp_path, CAR, LANDER)
    assert len(stored(page)) == 1 and "Left out: 1</summary><ul><li>mountaincar, otr, depth 1, seed 0" in page
    assert "left out: mountaincar, otr, depth 1, seed 0" in capsys.readouterr().out
    with pytest.raises(PipelineError, match="too many leaves to be held as leaves"):
        write_run_page([CAR], None, tmp_path / "none.html", config_of)
    assert not (tmp_path / "none.html").exists()


def test_the_command_names_the_file_and_refuses_what_it_cannot_show(tmp_path: Path) -> None:
    done = otr_succeeds("otr-report", f"run={CAR}", "out=car.html", cwd=tmp_path)
    assert re.search(r"^car\.html: 0\.\d MB, open it in any browser$", done.stdout, re.M)
    for words, told in (
        (["tree=pruned"], "of which run? Add run=FOLDER"),
        ([f"run={CAR}", "tree=compact"], "tree=compact: the page shows"),
        ([f"run={CAR}", "env=pendulum"], "an existing run, or one to make"),
        ([f"run={CAR}", "out=/dev/null/x.html"], "/dev/null/x.html: cannot be written ("),
        (["rnu=a"], "there is no key 'rnu'. Did you mean run"),
        (["results_dir=nowhere"], "there is no finished run"),
        (["gallery=a", f"run={CAR}"], "it chooses its runs and files"),
        (["run=nowhere/otr"], "nowhere/otr"),
    ):
        done = otr_command("otr-report", *words, cwd=tmp_path)
        assert done.returncode in (1, 2) and told in done.stderr + done.stdout, (words, done.stderr)
