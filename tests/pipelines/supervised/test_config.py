import dataclasses
from typing import get_type_hints

import pytest
from sklearn.utils._param_validation import validate_parameter_constraints

from otr import learners
from pipelines.config.setting import Range, declared
from pipelines.errors import ConfigError
from pipelines.supervised.config import LEARNERS, DataConfig, combinations, fit_folder, fit_settings, tune_settings
from pipelines.supervised.fit_job import fit_groups
from pipelines.supervised.learners import ESTIMATORS


def test_grid_is_all_combinations_of_each_part(fit_of):
    grid = [{"max_depth": [1, 2], "min_samples_leaf": [3, 4]}, {"max_depth": [9]}]
    found = [tuple(changes.values()) for changes in combinations(fit_of("cart", grid=grid).method)]
    assert found == [(1, 3), (1, 4), (2, 3), (2, 4), (9,)]


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"grid": [{"depth": [1]}]}, "has no setting 'depth'"),
        ({"grid": [{"max_depth": []}]}, "needs a list of values"),
        ({"grid": [{"max_depth": 3}]}, "needs a list of values"),
        ({"grid": [{"max_depth": [3]}], "tuning_seeds": []}, "tuning_seeds is empty"),
        ({"grid": [{"max_depth": [3, 0]}]}, "method.grid: max_depth=0 is not at least 1"),
        ({"grid": [{"teacher": [{"n_estimators": 5}]}]}, "tuned_for=label with a teacher, who teaches all labels"),
        ({"tuned_for": "seed"}, "use one of label, data"),
    ],
)
def test_wrong_grids_are_refused(fit_of, settings, message):
    with pytest.raises(ConfigError, match=message):
        fit_of("cart", **settings)


def test_stages_depend_on_whether_something_is_tuned(fit_of):
    assert fit_of("cart").all_stages == ("fit", "score")
    assert fit_of("cart", grid=[{"max_depth": [1]}]).all_stages == ("tune", "fit", "score")
    with pytest.raises(ConfigError, match="has no stage 'tune'"):
        dataclasses.replace(fit_of("cart"), stages=["tune"])
    with pytest.raises(ConfigError, match=r"stages=\[\] does nothing"):
        dataclasses.replace(fit_of("cart"), stages=[])


def test_folder_names_the_fit_and_digests_other_settings(fit_of):
    baseline = fit_of("cart", seed=3)
    assert fit_folder(baseline, {}) == "runs/breast_cancer/cart/seed-3"
    other = fit_folder(baseline, {"method.max_depth": [2, None]})
    assert other.startswith("runs/breast_cancer/cart/seed-3~") and len(other.split("~")[1]) == 8


def test_parts_drawn_anew_have_folders_of_their_own(fit_of):
    published = fit_of("cart", data="bace", seed=3)
    split = dataclasses.replace(published, data=DataConfig("bace", 2))
    assert fit_folder(split, {}) == "runs/bace/cart/split-2/seed-3"
    assert fit_settings(split) != fit_settings(published) and tune_settings(split) != tune_settings(published)
    assert "split" not in published.settings()["data"]  # so that fits from before it was a setting are found
    with pytest.raises(ConfigError, match="digits has no scaffolds"):
        dataclasses.replace(published, data=DataConfig("digits", 2))


def test_tuning_does_not_depend_on_the_seed_and_fitting_does(fit_of):
    one, two = fit_of("cart", seed=0), fit_of("cart", seed=1)
    assert tune_settings(one) == tune_settings(two)
    assert fit_settings(one) != fit_settings(two)


def test_molecules_are_keyed_by_the_hashes_of_their_files(fit_of):
    assert len(fit_settings(fit_of("cart", data="bace"))["data"]["git_blobs"]) == 3


def test_seeds_of_one_method_make_a_group(fit_of):
    configs = [fit_of("cart", seed=seed) for seed in range(3)]
    configs.insert(1, fit_of("otr", seed=0))
    assert fit_groups(configs) == [[0, 2, 3], [1]]
    assert fit_groups([dataclasses.replace(config, seeds_per_process=2) for config in configs]) == [[0, 2], [1], [3]]


@pytest.mark.parametrize("learner", LEARNERS)
def test_what_a_setting_may_be_the_estimator_takes(learner):
    kind = LEARNERS[learner]
    for name, hint in get_type_hints(kind).items():
        ranges = [marker for marker in declared(kind)[name] if isinstance(marker, Range)]
        values = [-1, 0, 1, 2] if hint in (int, int | None) else [-1.0, 0.0, 0.5, 1.0, 2.0] if hint is float else []
        for value in (value for value in values if ranges[0].problem(value) is None):
            for estimator in (getattr(learners, of_task) for of_task in ESTIMATORS[learner] if of_task):
                known = {name: estimator._parameter_constraints.get(name, "no_validation")}
                validate_parameter_constraints(known, {name: value}, estimator.__name__)


def test_settings_that_are_as_before_are_not_keyed(fit_of):
    assert "leaf_values" not in fit_settings(fit_of("tao"))["method"]
    assert fit_settings(fit_of("tao", leaf_values="labels"))["method"]["leaf_values"] == "labels"
    for learner in LEARNERS:
        assert "class_weight" not in fit_settings(fit_of(learner))["method"]
        assert fit_settings(fit_of(learner, class_weight="balanced"))["method"]["class_weight"] == "balanced"
    with pytest.raises(ConfigError, match=r"method\.class_weight=even: use one of balanced"):
        fit_of("cart", class_weight="even")
