"""The page in headless Chromium: the browser's tree answers as ours, the episode plays, names are names, keys work."""

import dataclasses
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import otr
from pipelines.cli.runs import load_config
from pipelines.report.webpage.gallery import write_gallery
from pipelines.report.webpage.page import write_results_page, write_run_page
from pipelines.report.webpage.policy import page_tree, tree_data
from tests.committed import RESULTS
from tests.core.test_tree import random_tree

pytestmark = pytest.mark.slow

# Of every head and kind of leaf, and of thousands of leaves.
RUNS = (
    "pendulum/otr/depth-6/quick/seed-0",
    "pendulum/otr/depth-32/quick/seed-0",
    "pendulum/linear/depth-0/quick/seed-0",
    "pendulum/pid/depth-1/quick/seed-0",
    "mountaincar/otr/depth-1/standard-ars/seed-0",
    "hopper/otr/depth-6/standard-ars/seed-6",
    "lunarlander/otr/depth-2/thesis/seed-0",
    "lunarlander/augtree/depth-10/quick/seed-0",
    "lunarlander/ndps/depth-10/quick/seed-0",
    "swimmer/viper/depth-6/quick/seed-0",
)
N_STATES = 200
MOVE = """(states) => states.map((state) => {
  state.forEach((share, j) => {
    const input = document.getElementById(`state-${j}`);
    input.value = Number(input.min) + share * (Number(input.max) - Number(input.min));
    input.dispatchEvent(new Event("input"));
  });
  return [Array.from(otr.view.x), otr.view.leaf, otr.view.answer];
})"""
SEEN = """(selector) => [...document.querySelectorAll(selector)].every(({ scrollWidth, clientWidth, parentElement }) =>
  scrollWidth <= clientWidth && scrollWidth <= parentElement.clientWidth)"""  # no column is cut off
SIZES = {"desk": (1280, 900), "phone": (390, 844)}


def config_of(run_dir: Path) -> Any:
    return load_config(run_dir, 1)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium, the machine's or Playwright's own; `make test-all` installs one."""
    from playwright.sync_api import sync_playwright

    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def ten(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folders = [RESULTS / "runs" / run for run in RUNS]
    return write_run_page(folders, "pruned", tmp_path_factory.mktemp("ten") / "page.html", config_of)


@pytest.fixture
def opened(browser: Any) -> Iterator[Any]:
    """Return what opens a file in a window of some size; an error in it, or a call to the network, fails the test."""
    wrong, windows = list[str](), []

    def open_page(path: Path, size: tuple[int, int] = SIZES["desk"], **looks: str) -> Any:
        window = browser.new_page(viewport={"width": size[0], "height": size[1]}, **looks)
        windows.append(window)
        window.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        window.on("pageerror", lambda error: wrong.append(str(error)))
        window.on("dialog", lambda dialog: wrong.append(dialog.message))
        own = ("file:", "data:", "blob:")
        window.on("request", lambda asked: None if asked.url.startswith(own) else wrong.append(asked.url))
        window.goto(path.as_uri())
        window.evaluate("otr.ready")
        return window

    yield open_page
    for window in windows:
        window.close()
    assert not wrong


def show(window: Any, policy: str) -> None:
    window.locator(f"a[data-policy={policy}]").first.click()
    window.evaluate("otr.ready")


@pytest.mark.parametrize("i", range(len(RUNS)), ids=RUNS)
def test_the_browser_answers_as_the_tree(ten: Path, opened: Any, i: int) -> None:
    window, folder = opened(ten), RESULTS / "runs" / RUNS[i]
    show(window, f"policy-{i}")
    tree = page_tree(config_of(folder), folder, "pruned")
    shares = np.random.default_rng(i).uniform(size=(N_STATES, tree.n_inputs))
    answered = window.evaluate(MOVE, shares.tolist())
    X = np.array([x for x, _, _ in answered])
    assert len(np.unique(X, axis=0)) == N_STATES
    # Sums in another order differ in the last bits: a state that lies on a test could go either way, and none does.
    np.testing.assert_array_equal([leaf for _, leaf, _ in answered], tree.apply(X))
    size = np.abs(tree.predict(X)).max()  # the page of several has its numbers in float32
    np.testing.assert_allclose([answer for _, _, answer in answered], tree.predict(X), rtol=0, atol=1e-5 * size)
    assert len({leaf for _, leaf, _ in answered}) > 1 or tree.n_leaves == 1


@pytest.mark.parametrize("labels", [None, np.arange(12) % 3])
def test_the_browser_finds_the_nearest_other_answer(ten: Path, opened: Any, labels: np.ndarray | None) -> None:
    window, rng = opened(ten), np.random.default_rng(0)
    tree = random_tree(rng, 12, 3, 3, 10).replace(labels=labels)
    low, high = np.array([-1.0, -2.0, -1.0]), np.array([1.0, 2.0, 3.0])
    X = low + rng.uniform(size=(50, 3)) * (high - low)
    features = [{"low": a, "high": b} for a, b in zip(low.tolist(), high.tolist(), strict=True)]
    find = "([data, X, features]) => X.map((x) => nearestOther(new Tree(data), x, features))"
    n_found = 0
    for x, found in zip(X, window.evaluate(find, [tree_data(tree, X), X.tolist(), features]), strict=True):
        explained = otr.explain(tree, x, scales=high - low, domain=(low, high))
        expected = explained.nearest_leaf if labels is None else explained.nearest_label
        assert (found is None) == (expected is None)
        if found is not None and expected is not None:
            assert found["distance"] == pytest.approx(expected.distance, abs=1e-4)
            np.testing.assert_allclose(found["state"], expected.state, atol=1e-3)
            assert found["leaf"] == expected.leaf
            np.testing.assert_allclose(found["answer"], expected.answer, atol=1e-2)
            n_found += 1
    assert n_found > 40


def test_it_is_said_why_and_the_nearest_state_is_gone_to(ten: Path, opened: Any) -> None:
    window = opened(ten)
    for policy in ("policy-5", "policy-6"):  # actions that are clipped, and labels
        show(window, policy)
        window.evaluate("otr.view.showStep(Math.floor(otr.view.episode.length / 2))")
        why = window.locator("section[aria-label='why this action']")
        summary, rows = why.locator("summary").first, why.locator("details").first.locator("tr")
        shares = [float(text.split()[0]) for text in rows.locator("td:nth-child(2)").all_inner_texts()]
        value = float(re.split("[=,→]", summary.inner_text())[1])
        assert sum(shares) == pytest.approx(value, abs=0.02 * max(map(abs, shares)))
        leaf, answer = window.evaluate("[otr.view.leaf, otr.view.answer]")
        why.get_by_role("button", name="Go there").click()
        gone, other = window.evaluate("[otr.view.leaf, otr.view.answer]")
        assert gone != leaf and (policy == "policy-5" or other != answer)
        matters = window.locator("section[aria-label='what matters']")
        assert matters.locator("thead th").all_inner_texts()[-1] == "decisions"


def test_the_episode_plays_and_the_path_moves_along(ten: Path, opened: Any) -> None:
    window = opened(ten)
    show(window, "policy-6")
    window.wait_for_function("otr.view.episode.picture.complete")
    picture = "[...otr.view.frame.getContext('2d').getImageData(0, 0, 160, 100).data].reduce((a, b) => a + b)"
    first = window.evaluate(picture)
    window.get_by_role("button", name="Play").click()
    window.wait_for_function("otr.view.step > 20")
    assert window.evaluate(picture) != first > 0
    leaf, recorded, lit, depth = window.evaluate("""() => {
      const { leaf, episode, step, tree } = otr.view;
      return [leaf, episode.leaves[step], document.querySelectorAll(".tree g.on").length, tree.pathTo(leaf).length];
    }""")
    assert leaf == recorded and lit == depth > 1
    window.get_by_role("button", name="Pause").click()
    stopped = window.evaluate("otr.view.step")
    window.wait_for_timeout(200)
    assert window.evaluate("otr.view.step") == stopped
    window.evaluate("otr.view.showStep(otr.view.episode.length - 3)")
    window.get_by_role("button", name="Play").click()
    at_end = "otr.view.step === otr.view.episode.length - 1"
    window.wait_for_function(f"{at_end} && otr.view.playButton.textContent === 'Play'")


def test_keys_move_the_state_and_open_a_leaf_and_all_has_a_name(ten: Path, opened: Any) -> None:
    window = opened(ten)
    show(window, "policy-6")
    low, high, before = window.evaluate("[otr.view.features[0].low, otr.view.features[0].high, otr.view.x[0]]")
    window.focus("#state-0")
    window.keyboard.press("ArrowRight")
    assert window.evaluate("otr.view.x[0]") == pytest.approx(before + (high - low) / 100)
    visited = window.evaluate("otr.view.episode.leaves[otr.view.episode.length - 1]")
    window.focus(f"[data-ref='{~visited}']")
    window.keyboard.press("Enter")
    assert window.evaluate("otr.view.leaf") == visited
    window.focus("[data-ref='0']")
    window.keyboard.press("Enter")  # what a box leaves out is said below the tree
    whole = window.inner_text("section[aria-label=tree] p[aria-live]")
    assert (
        "more" in window.text_content("[data-ref='0'] text:nth-of-type(4)")
        and whole.count(" + ") + whole.count(" − ") == 8
    )
    nameless = window.evaluate("""() => {
      const told = (e) => e.labels?.length || e.ariaLabel || e.textContent.trim();
      const named = (e) => told(e) || e.closest("[role=img][aria-label]");
      const all = document.querySelectorAll("input, button, select, canvas, [role=button], [role=img]");
      return [...all].filter((e) => !named(e)).map((e) => e.outerHTML);
    }""")
    assert nameless == []


def test_a_tree_of_thousands_of_leaves_stays_usable(tmp_path: Path, opened: Any) -> None:
    folder = RESULTS / "runs" / RUNS[1]
    window = opened(write_run_page([folder], "minimal", tmp_path / "page.html", config_of))
    n_leaves = window.evaluate("otr.view.tree.nLeaves")
    assert window.evaluate("document.querySelectorAll('rect.cell:not(.inner)').length") == n_leaves > 2000
    search, found = window.locator("input[type=search]"), "[...document.querySelectorAll('.found')]"
    search.fill("12")
    assert window.evaluate(f"{found}.map((cell) => ~Number(cell.dataset.ref))") == [11]
    search.fill("angle_rate")
    n_found = window.evaluate(f"{found}.length")
    assert n_found > 1000 and f"{n_found} found" in window.inner_text("p:has(> input[type=search])")
    opened_path = "document.querySelectorAll('.path details').length + 1"
    assert window.evaluate(opened_path) == window.evaluate("otr.view.tree.pathTo(otr.view.leaf).length") > 5


def test_names_are_names_in_the_browser_too(tmp_path: Path, opened: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    evil = "</script><img src=x onerror=alert(1)>"
    monkeypatch.setattr("pipelines.report.webpage.policy.feature_names", lambda env, n: [evil, "velocity"])

    def named(run_dir: Path) -> Any:
        config = config_of(run_dir)
        return dataclasses.replace(config, env=dataclasses.replace(config.env, name=evil))

    page = write_run_page([RESULTS / "runs" / RUNS[4]], None, tmp_path / "page.html", named)
    window = opened(page)
    assert evil in window.inner_text("#view > p") and evil in window.inner_text("label[for=state-0]")
    assert window.locator("img").count() == 0


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_runs_over_the_edge(ten: Path, opened: Any, size: str, scheme: str) -> None:
    window = opened(ten, SIZES[size], color_scheme=scheme)
    for i in range(len(RUNS)):
        show(window, f"policy-{i}")
        assert window.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
        cut = """() => [...document.querySelectorAll(".tree g")].flatMap((box) => {
          const [frame, ...texts] = [...box.querySelectorAll("rect, text")].map((e) => e.getBBox());
          return texts.filter((t) => t.x + t.width > frame.width || t.y + t.height > frame.height + 1);
        }).length"""
        assert window.evaluate(cut) == 0
        n_nodes, edges = window.evaluate("[otr.view.tree.nNodes, document.querySelectorAll('.tree .edge').length]")
        assert edges in (2 * n_nodes, 0) and (edges == 0) == (n_nodes >= 40 or n_nodes == 0)
        is_larger = window.evaluate("(({scrollWidth, clientWidth}) => scrollWidth > clientWidth + 1)(otr.view.treeBox)")
        assert "scroll in it" in window.inner_text(".tree + p") or not is_larger
    assert window.evaluate("getComputedStyle(document.body).backgroundColor") == {
        "light": "rgb(255, 255, 255)", "dark": "rgb(20, 24, 28)"}[scheme]  # fmt: skip


def test_tables_sort_and_numbers_open_their_policy(tmp_path: Path, opened: Any) -> None:
    for run in (RUNS[0], RUNS[2], RUNS[5], RUNS[9]):
        place = tmp_path / "results/runs" / run
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(RESULTS / "runs" / run)
    window = opened(write_results_page(tmp_path / "results", tmp_path / "page.html", config_of))
    column = window.locator("thead th", has_text="OTR (6)").first
    order = """() => {
      const { tHead, tBodies } = document.querySelector("table");
      const at = [...tHead.rows[0].cells].findIndex((cell) => cell.textContent.startsWith("OTR (6)"));
      return [...tBodies[0].rows].map((row) => row.cells[at].dataset.value).filter((value) => value).map(Number);
    }"""
    column.locator("button").focus()
    window.keyboard.press("Enter")
    values = window.evaluate(order)
    assert values == sorted(values) and len(values) == 2 and column.get_attribute("aria-sort") == "ascending"
    column.locator("button").click()
    assert window.evaluate(order) == values[::-1]
    link = window.locator("a[data-policy]").last
    link.click()
    window.evaluate("otr.ready")
    shown = window.locator(".list a[aria-current]")
    assert shown.get_attribute("data-policy") == link.get_attribute("data-policy")
    assert window.locator("#figure-seconds canvas").count() == 1
    window.locator(".list thead button", has_text="Return").click()
    listed = window.eval_on_selector_all(
        ".list tbody td:nth-child(3)", "all => all.map((e) => Number(e.dataset.value))"
    )
    assert listed == sorted(listed) and len(listed) == window.locator("script.policy").count()


def test_lines_are_told_apart_without_colour_and_labels_are_steps(ten: Path, opened: Any) -> None:
    window = opened(ten)
    show(window, "policy-6")
    actions, states = window.evaluate("""otr.view.charts.map(({ series, axes, _ }) => series.slice(1).map((each) =>
      [each.dash.join(), each.label[0], each.value(null, 2)]))""")
    assert actions[0][2] == "main_engine" and len(actions) == 1
    assert len(states) == len({dash for dash, _, _ in states}) == len({mark for _, mark, _ in states}) == 8
    shown = window.evaluate("""() => {
      const [place, at] = [document.createElement("div"), [0, 1, 2]];
      document.body.append(place);
      const lines = Array.from({ length: 12 }, (_, i) => ({ label: `${i}`, values: [i, 1, 2], show: i < 8 }));
      const chart = addChart(place, { x: "a", y: "b" }, at, lines);
      chart.setSeries(10, { show: true });
      return chart.series.map(({ show }, i) => show ? i : 0).filter((i) => i);
    }""")
    assert shown == [1, 3, 4, 5, 6, 7, 8, 10]  # the tenth in the place of the second, whose looks it has


@pytest.mark.parametrize("size", SIZES)
def test_the_gallery_is_light_and_its_pages_open(tmp_path: Path, opened: Any, size: str) -> None:
    index = write_gallery(RESULTS, tmp_path, config_of)
    window = opened(index, SIZES[size])
    links = window.eval_on_selector_all(".list a", "all => all.map((link) => link.getAttribute('href'))")
    assert len(links) == 10 and window.locator(".list img").count() == 10
    assert window.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
    assert window.evaluate(SEEN, ".list")
    for link in links:
        assert (tmp_path / link).stat().st_size < 200_000
        page = opened(tmp_path / link, SIZES[size])
        assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
        assert page.inner_text(".lead").startswith("Returns ") and page.locator("pre.program").count() >= 1
        assert page.evaluate(SEEN, ".returns")
