"""The stages themselves, on scikit-learn's data sets."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import roc_auc_score
from sklearn.preprocessing import StandardScaler

import otr
from otr.learners import CARTClassifier, LinearTreeClassifier, OTRClassifier, TAOClassifier
from otr.learners.distillation import Teacher, distillation_set, fit_teacher
from pipelines.cli.pack import pack_results
from pipelines.datasets.load import load_dataset
from pipelines.engine.job import is_done
from pipelines.engine.store import ARCHIVE, read_csv, read_json
from pipelines.errors import ConfigError
from pipelines.report import load_fits
from pipelines.supervised.fit import fit
from pipelines.supervised.fit_job import FitJob, fit_job, fit_jobs
from pipelines.supervised.learners import check_learner, fit_trees
from pipelines.supervised.tune import best_of, checkpoint_folder, mean_over_trials, tune

GRID = [{"max_depth": [1, 2, 5]}]


def job_of(config):
    return FitJob(config, config.folder, "data: {}\n")


def test_scores_and_predictions_are_those_of_the_kept_tree(fit_of):
    job = job_of(fit_of("otr", hidden=[3], epochs=8))
    summary = fit_job(job)
    dataset = load_dataset("breast_cancer")
    whole = otr.load(job.run_dir / "fit" / "label-00")
    tree = otr.prune_unreached(whole, dataset.train.X)
    for part in ("train", "valid", "test"):
        X, y = dataset.labelled(part)
        for name, each in ((part, tree), (f"whole_{part}", whole)):
            assert summary[name] == pytest.approx(roc_auc_score(y, each.forward(X)[:, 0]), abs=1e-7)
    (row,) = read_csv(job.run_dir / "score" / "scores.csv")
    assert float(row["test"]) == pytest.approx(summary["test"])
    assert (int(row["leaves"]), int(row["depth"])) == (tree.n_leaves, tree.depth)
    predictions = np.load(job.run_dir / "score" / "predictions.npz")
    assert all(predictions[name].dtype == np.float64 for name in predictions)
    for name, each in (("test", tree), ("whole", whole)):
        assert np.allclose(predictions[name][:, 0], each.forward(dataset.test.X)[:, 0], rtol=1e-6)
    assert (predictions["labels"] == dataset.test.Y).all()
    assert (job.run_dir / "score" / "program.txt").read_text().startswith("if ")
    assert (job.run_dir / "fit" / "tree.png").exists()


def test_seeds_together_are_the_seeds_alone(fit_of):
    jobs = [job_of(fit_of("otr", seed=seed, hidden=[3], epochs=3)) for seed in range(3)]
    assert fit_jobs(jobs) == [None] * 3
    dataset = load_dataset("breast_cancer")
    X, y = dataset.labelled("train")
    for seed, job in enumerate(jobs):
        alone = OTRClassifier((3,), epochs=3, decay_every=10, random_state=seed).fit(
            X, y, validation=dataset.labelled("valid")
        )
        tree = otr.load(job.run_dir / "fit" / "label-00")
        assert np.allclose(tree.forward(X)[:, 0], alone.decision_function(X), rtol=1e-3, atol=1e-3)
    assert len({read_json(job.run_dir / "summary.json")["train"] for job in jobs}) == 3


def test_what_is_tuned_is_the_best_on_the_validation_part(fit_of):
    job = job_of(fit_of("cart", grid=GRID))
    fit_job(job)
    rows = read_csv(job.run_dir / "tune" / "candidates.csv")
    best = max(rows, key=lambda row: float(row["valid"]))
    (chosen,) = read_json(job.run_dir / "tune" / "chosen.json")
    assert chosen["settings"] == json.loads(best["settings"])
    tree = otr.load(job.run_dir / "fit" / "label-00")
    assert tree.depth == chosen["settings"]["max_depth"]
    assert read_json(job.run_dir / "summary.json")["valid"] == pytest.approx(float(best["valid"]), abs=0.05)


def test_a_packed_fit_is_one_file_of_which_tables_read_the_summary(fit_of, tmp_path):
    config = fit_of("cart", grid=GRID)
    job = FitJob(config, config.folder, "results_dir: elsewhere\n")
    summary = fit_job(job)
    before = load_fits(config.results_dir)
    pack_results(Path(config.results_dir))
    assert [path.name for path in job.run_dir.iterdir() if path.is_file() and path.suffix != ".lock"] == [ARCHIVE]
    pd.testing.assert_frame_equal(load_fits(config.results_dir), before)
    assert fit_job(job) == summary


def test_the_teacher_of_the_networks_is_scored_beside_them(fit_of):
    forest = {"forest": "random_forest", "n_estimators": 20, "n_copies": 1}
    grid = [{"teacher": [forest | {"weight_of_linear": 0.5}]}]
    summary = fit_job(job_of(fit_of("otr", seed=3, hidden=[2], epochs=2, grid=grid, tuned_for="data")))
    dataset = load_dataset("breast_cancer")
    X, y = dataset.labelled("train")
    scaler = StandardScaler().fit(X)  # as the networks see it
    teacher = fit_teacher(scaler.transform(X), y, Teacher(**forest, weight_of_linear=0.5), seed=3)
    for part in ("train", "valid", "test"):
        rows, labels = dataset.labelled(part)
        expected = roc_auc_score(labels, teacher.predict_proba(scaler.transform(rows))[:, 0])
        assert summary["teacher"][part] == pytest.approx(expected)
    assert "teacher" not in fit_job(job_of(fit_of("otr", seed=4, hidden=[2], epochs=2)))


@pytest.mark.parametrize(
    ("learner", "estimator", "settings"),
    [
        ("cart", CARTClassifier, {"max_depth": 3}),
        ("tao", TAOClassifier, {"max_depth": 3}),
        ("linear", LinearTreeClassifier, {"C": 0.1, "max_depth": 0}),
    ],
)
def test_other_trees_learn_from_the_same_teacher(fit_of, learner, estimator, settings):
    forest = {"forest": "random_forest", "n_estimators": 5, "n_copies": 1}
    job = job_of(fit_of(learner, teacher=forest, seed=3, **settings))
    summary = fit_job(job)
    dataset = load_dataset("breast_cancer")
    rows, targets = distillation_set(*dataset.labelled("train"), Teacher(**forest), seed=3)
    p = targets[:, 0]
    usual = {"max_iter": 14, "tol": 0.005, "surrogate": "squared_hinge", "C": 1.0} if learner == "tao" else {}
    drawn = {} if learner == "linear" else {"random_state": 3}
    alone = estimator(**settings, **usual, **drawn).fit(
        np.concatenate([rows, rows]).astype(np.float32), np.repeat([1.0, 0.0], len(rows)), np.concatenate([p, 1 - p])
    )
    tree = otr.load(job.run_dir / "fit" / "label-00")
    for name in ("P", "v", "children_left", "c"):
        np.testing.assert_array_equal(getattr(tree, name), getattr(alone.tree_, name))
    assert summary["test"] > 0.9 and summary["teacher"]["test"] > 0.9
    other = fit_job(job_of(fit_of(learner, seed=4, **settings)))
    assert (other["train"], other["leaves"]) != (summary["train"], summary["leaves"])


def test_a_setting_that_the_estimator_lacks_is_refused(fit_of):
    with pytest.raises(ConfigError, match=r"method\.C=5: LinearTreeRegressor, which diabetes takes, has no C"):
        check_learner(fit_of("linear", C=5).method, load_dataset("diabetes"))
    check_learner(fit_of("linear").method, load_dataset("diabetes"))  # which has C of its own accord


def test_a_teacher_is_for_labels_and_has_no_class_weights(fit_of):
    method = fit_of("cart", teacher={"n_estimators": 5}).method
    with pytest.raises(ConfigError, match=r"method\.teacher is for binary labels, and diabetes is a regression"):
        check_learner(method, load_dataset("diabetes"))
    with pytest.raises(
        ConfigError, match=r"method\.teacher is for binary labels, and digits has more than two classes"
    ):
        check_learner(method, load_dataset("digits"))
    shared = fit_of("otr", hidden=[4], shared=True).method
    with pytest.raises(ConfigError, match=r"method\.shared is for binary labels, and digits has more than two classes"):
        check_learner(shared, load_dataset("digits"))
    with pytest.raises(ConfigError, match="its rows have weights of their own"):
        check_learner(dataclasses.replace(method, class_weight="balanced"), load_dataset("breast_cancer"))
    with pytest.raises(ConfigError, match=r"method\.teacher=5: give values by name, as {forest: random_forest}"):
        check_learner(dataclasses.replace(method, teacher=5), load_dataset("breast_cancer"))


def test_each_combination_is_checked_before_any_is_fitted(fit_of):
    taught = fit_of("linear", grid=[{"C": [1.0]}, {"teacher": [{"n_estimators": 5}]}], tuned_for="data").method
    check_learner(taught, load_dataset("breast_cancer"))
    with pytest.raises(ConfigError, match="its rows have weights of their own"):
        check_learner(dataclasses.replace(taught, class_weight="balanced"), load_dataset("breast_cancer"))
    with pytest.raises(ConfigError, match=r"LinearTreeRegressor, which diabetes takes, has no C; leave it out"):
        check_learner(fit_of("linear", grid=[{"C": [1.0]}]).method, load_dataset("diabetes"))


@pytest.mark.parametrize("tuned_on", ["valid", "folds"])
@pytest.mark.parametrize("learner, grid", [("cart", GRID), ("otr", [{"hidden": [[2], [3]], "epochs": [2]}])])
def test_tuning_and_fitting_never_read_the_test_part(fit_of, monkeypatch, tmp_path, learner, grid, tuned_on):
    dataset = dataclasses.replace(load_dataset("breast_cancer"), test=None)
    config = fit_of(learner, grid=grid, tuned_on=tuned_on)
    for stage in ("tune", "fit"):
        monkeypatch.setattr(f"pipelines.supervised.{stage}.dataset_of", lambda config: dataset)
        (tmp_path / stage).mkdir()
    tune({}, config, tmp_path / "tune")
    fit({"tune": tmp_path / "tune"}, config, tmp_path / "fit")
    assert (tmp_path / "fit" / "label-00.npz").exists()


def test_tuning_on_folds_takes_the_mean_over_them(fit_of, tmp_path):
    tune({}, fit_of("cart", grid=GRID, tuned_on="folds"), tmp_path)
    scores = []
    for fold in load_dataset("breast_cancer").folds():
        model = CARTClassifier(max_depth=2, random_state=1000).fit(*fold.labelled("train"))
        X, y = fold.labelled("test")
        scores.append(roc_auc_score(y, model.predict_proba(X)[:, 1]))
    told = {row["settings"]: float(row["valid"]) for row in read_csv(tmp_path / "candidates.csv")}
    assert told['{"max_depth": 2}'] == pytest.approx(np.mean(scores), abs=1e-6)
    assert np.std(scores) > 0.001


def test_a_label_of_one_class_in_a_fold_is_left_out_there(fit_of, monkeypatch, tmp_path):
    dataset = load_dataset("breast_cancer")
    rare = np.zeros((len(dataset.train.Y), 1))
    rare[:2] = 1  # in one fold or two of five
    train = dataclasses.replace(dataset.train, Y=np.hstack([dataset.train.Y, rare]))
    valid = dataclasses.replace(dataset.valid, Y=np.hstack([dataset.valid.Y, np.zeros((len(dataset.valid.Y), 1))]))
    two = dataclasses.replace(dataset, train=train, valid=valid, label_names=("benign", "rare"))
    monkeypatch.setattr("pipelines.supervised.tune.dataset_of", lambda config: two)
    tune({}, fit_of("cart", grid=GRID, tuned_on="folds"), tmp_path)
    assert [each["settings"].keys() for each in read_json(tmp_path / "chosen.json")] == [{"max_depth"}] * 2


def test_a_class_of_few_rows_is_in_the_training_rows_of_every_fold(fit_of, monkeypatch, tmp_path):
    dataset = load_dataset("breast_cancer")
    Y = dataset.train.Y.copy()
    Y[:3] = 2  # in one fold, if folds had no strata
    three = dataclasses.replace(dataset, train=dataclasses.replace(dataset.train, Y=Y))
    folds = three.folds()
    assert all(len(np.unique(fold.train.Y)) == 3 for fold in folds)
    without = [
        dataclasses.replace(fold, train=fold.train.take(np.flatnonzero(fold.train.Y[:, 0] > 0))) for fold in folds
    ]
    monkeypatch.setattr("pipelines.supervised.tune.dataset_of", lambda config: three)
    monkeypatch.setattr("pipelines.datasets.dataset.Dataset.folds", lambda self: without)
    tune({}, fit_of("cart", grid=GRID, tuned_on="folds"), tmp_path)  # of trees that answer 1 and 2 by positions 0 and 1
    share = np.mean([(fold.test.Y == 1).mean() for fold in folds])
    assert max(float(row["valid"]) for row in read_csv(tmp_path / "candidates.csv")) == pytest.approx(share, abs=0.02)


def test_a_teacher_rounds_no_numbers(fit_of):
    rng, n = np.random.default_rng(0), 200
    dataset = load_dataset("breast_cancer")
    X = 1.7e9 + rng.permutation(n)[:, None]  # seconds, which float32 holds to 128
    part = dataclasses.replace(dataset.train, X=X, Y=(1.7e9 + n / 2 < X).astype(float))
    timed = dataclasses.replace(dataset, train=part, valid=part, test=part, feature_names=("time",))
    method = fit_of("cart", max_depth=3, teacher={"n_estimators": 20}).method
    ((fitted,),) = fit_trees(method, timed, [0], [0])
    assert (fitted.tree.predict(X) == part.Y[:, 0]).mean() > 0.95


def test_seeds_share_what_was_tuned_and_only_one_tunes(fit_of, monkeypatch):
    tuned = []
    import pipelines.supervised.tune as module

    real = module._scores
    monkeypatch.setattr(module, "_scores", lambda *arguments: tuned.append(1) or real(*arguments))
    jobs = [job_of(fit_of("cart", seed=seed, grid=GRID)) for seed in range(2)]
    assert fit_jobs(jobs) == [None, None]
    assert len(tuned) == 3
    first, second = ((job.run_dir / "tune" / "candidates.csv").read_text() for job in jobs)
    assert first == second


def test_killed_tuning_goes_on_with_the_next_combination(fit_of, monkeypatch):
    import pipelines.supervised.tune as module

    config = fit_of("cart", grid=GRID)
    fitted = []
    real = module.fit_trees

    def killed_at_the_third(method, *arguments, **options):
        fitted.append(method.max_depth)
        if len(fitted) == 3:
            raise KeyboardInterrupt
        return real(method, *arguments, **options)

    monkeypatch.setattr(module, "fit_trees", killed_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        fit_job(job_of(config))
    assert len(list(checkpoint_folder(config).glob("*.json"))) == 2
    fit_job(job_of(config))
    assert fitted == [1, 2, 5, 5]
    assert not checkpoint_folder(config).exists()


def test_done_fits_are_found_again_with_and_without_their_trees(fit_of, capsys):
    job = job_of(fit_of("cart", grid=GRID))
    fit_job(job)
    assert is_done(job)
    shutil.rmtree(job.run_dir / "fit")
    assert is_done(job)
    fit_job(job)
    assert "done before" in capsys.readouterr().out
    for damaged in ("score/scores.csv", "tune/chosen.json"):
        before = (job.run_dir / damaged).read_text()
        (job.run_dir / damaged).write_text("changed")
        assert not is_done(job)
        (job.run_dir / damaged).write_text(before)
        assert is_done(job)


def test_a_learner_that_is_not_for_the_task_says_so(fit_of):
    with pytest.raises(ConfigError, match="tao is not for regression, which diabetes is"):
        fit_job(job_of(fit_of("tao", data="diabetes")))


def test_class_weights_reach_the_learner(fit_of):
    dataset = load_dataset("breast_cancer")
    weighed, plain = (fit_of("cart", max_depth=1, class_weight=w).method for w in ("balanced", None))
    shares = [fit_trees(method, dataset, [0], [0])[0][0].tree.c for method in (weighed, plain)]
    X, y = dataset.labelled("train", 0)
    expected = CARTClassifier(max_depth=1, class_weight="balanced", random_state=0).fit(X, y).tree_.c
    np.testing.assert_allclose(shares[0], expected)
    assert np.abs(shares[0] - shares[1]).max() > 0.01
    with pytest.raises(ConfigError, match="class_weight is for classes, and diabetes has numbers"):
        fit_job(job_of(fit_of("cart", data="diabetes", class_weight="balanced")))


@pytest.mark.parametrize("learner", ["linear", "cart", "hhcart", "augtree", "lcn", "otr"])
def test_every_learner_does_a_regression(fit_of, learner):
    settings = {"epochs": 4} if learner in ("lcn", "otr") else {}
    settings |= {"max_depth": 3} if learner in ("linear", "cart", "hhcart", "augtree") else {}
    summary = fit_job(job_of(fit_of(learner, data="diabetes", **settings)))
    assert summary["metric"] == "rmse" and 40 < summary["test"] < 75  # the targets' deviation is about 77


@pytest.mark.parametrize("learner", ["linear", "cart", "hhcart", "tao", "augtree", "otr"])
def test_every_classifier_does_many_classes(fit_of, learner):
    settings = {"epochs": 4} if learner == "otr" else {}
    settings |= {"max_depth": 4} if learner in ("cart", "hhcart", "tao", "augtree") else {}
    settings |= {"max_depth": 1} if learner == "linear" else {}
    summary = fit_job(job_of(fit_of(learner, data="digits", **settings)))
    assert summary["metric"] == "accuracy" and summary["test"] > 0.4


@pytest.mark.parametrize(
    "scores, for_label, best",
    [
        ([[0.6, 0.9], [0.8, 0.7]], True, [1, 0]),
        ([[0.6, 0.9], [0.8, 0.8]], False, [1, 1]),
        ([[0.6, np.nan, 0.9], [0.8, np.nan, 0.8]], True, [1, 1, 0]),  # what serves the others best
        ([[np.nan], [np.nan]], True, [0]),
        ([[0.7], [0.7]], True, [0]),  # the first of equals
        ([[0.6, 0.6], [np.nan, np.nan], [0.7, 0.7]], False, [2, 2]),  # a training that diverged
        ([[0.6, 0.6], [0.9, np.nan]], False, [0, 0]),
    ],
)
def test_best_combination(scores, for_label, best):
    assert best_of(np.array(scores), for_label, "auc") == best
    assert best_of(-np.array(scores), for_label, "rmse") == best


def test_means_over_trials_leave_out_what_tells_nothing_and_keep_what_failed():
    nan = np.nan
    parts = np.array([[[0.6, nan], [0.8, nan]], [[0.4, 0.5], [nan, 0.7]]])  # of 2 trials, 2 combinations and 2 labels
    np.testing.assert_array_equal(mean_over_trials(parts), [[0.5, 0.5], [nan, 0.7]])
    np.testing.assert_array_equal(mean_over_trials(np.full((2, 1, 1), nan)), [[nan]])


def test_a_combination_that_diverges_is_told_and_not_chosen(fit_of, capsys):
    rates = [{"learning_rate": [0.01, 1e6], "hidden": [[4]]}]
    job = job_of(fit_of("otr", data="diabetes", grid=rates, epochs=4))
    assert fit_job(job)["test"] < 100
    assert '"learning_rate": 1000000.0' in (told := capsys.readouterr().out) and "diverged" in told
    (chosen,) = read_json(job.run_dir / "tune" / "chosen.json")
    assert chosen["settings"]["learning_rate"] == 0.01
