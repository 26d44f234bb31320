"""Every parameter is declared, and a value that it may not have ends in an error that names both."""

import inspect
from contextlib import suppress

import numpy as np
import pytest
from sklearn.utils._param_validation import InvalidParameterError, generate_invalid_param_val, make_constraint
from sklearn.utils.estimator_checks import check_param_validation

import otr
from otr import learners
from otr.learners.base.parameters import Widths
from otr.learners.distillation import Teacher
from otr.learners.networks.batched_lcn import LcnSettings
from otr.learners.networks.batched_mlp import MlpSettings
from otr.learners.networks.batched_training import Schedule, schedule_of

ESTIMATORS = [cls for cls in (getattr(learners, name) for name in learners.__all__) if isinstance(cls, type)]
OTR = learners.OTRClassifier


def problem():
    X = np.random.default_rng(0).normal(size=(20, 3))
    return X, np.arange(20) % 2


@pytest.mark.parametrize("cls", ESTIMATORS)
def test_scikit_learns_check_of_every_parameter(cls):
    """All are declared, and each refuses a wrong type and values out of its ranges, with its name in the message."""
    check_param_validation(cls.__name__, cls())


@pytest.mark.parametrize("cls", [Teacher, Schedule, MlpSettings, LcnSettings])
def test_settings_refuse_what_estimators_do(cls):
    assert set(cls._parameter_constraints) == set(inspect.signature(cls).parameters)
    for name, constraints in cls._parameter_constraints.items():
        refused = [type("BadType", (), {})()]
        for constraint in map(make_constraint, constraints):
            with suppress(NotImplementedError):
                refused.append(generate_invalid_param_val(constraint))
        for value in refused:
            with pytest.raises(InvalidParameterError, match=f"^The '{name}' parameter of {cls.__name__} must be"):
                cls(**{name: value})


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"hidden": 8}, "a sequence, each item an int in the range [1, inf). Got 8 instead."),
        ({"hidden": [8, -1]}, "a sequence, each item an int in the range [1, inf). Got [8, -1] instead."),
        ({"hidden": "88"}, "a sequence, each item an int in the range [1, inf). Got '88' instead."),
        ({"hidden": [8.0]}, "a sequence, each item an int in the range [1, inf). Got [8.0] instead."),
        ({"epochs": 0}, "an int in the range [1, inf) or None. Got 0 instead."),
        ({"batch_size": 0}, "an int in the range [1, inf). Got 0 instead."),
        ({"decay_every": 0}, "an int in the range [1, inf) or None. Got 0 instead."),
        ({"learning_rate": "a"}, "a float in the range (0.0, inf). Got 'a' instead."),
        ({"learning_rate": np.nan}, "a float in the range (0.0, inf). Got nan instead."),
        ({"input_dropout": 1.0}, "a float in the range [0.0, 1.0). Got 1.0 instead."),
        ({"standardize": 1}, "a str among {'auto'}. Got 1 instead."),
        ({"teacher": 3}, "None. Got 3 instead."),
        ({"max_leaves": 2.5}, "an int in the range [1, inf). Got 2.5 instead."),
        ({"dense": "x"}, "Got 'x' instead."),
    ],
)
def test_what_the_message_says(parameters, expected):
    (name,) = parameters
    for fit in (OTR(**parameters).fit, lambda X, y: OTR(**parameters).fit_seeds(X, y, [0])):
        with pytest.raises(ValueError) as raised:
            fit(*problem())
        assert isinstance(raised.value, TypeError)
        assert str(raised.value).startswith(f"The {name!r} parameter of OTRClassifier must be ")
        assert str(raised.value).endswith(expected)


def test_parameters_of_the_same_kind_do_as_well():
    X, y = problem()
    for hidden in ([4], np.array([4]), (4,)):
        model = OTR(hidden, epochs=np.int64(1), learning_rate=np.float32(0.1), shared=np.bool_(False), random_state=0)
        assert model.fit(X, y).network_.hidden_widths == (4,)
    assert (
        OTR((2, 2), dense=True, epochs=1).fit(X, y).network_.dense
        == OTR((2, 2), dense="all", epochs=1).fit(X, y).network_.dense
    )


def test_the_schedule_of_the_defaults():
    """1,000 steps: two an epoch of 100 rows; and 30 epochs at least."""
    lcn, otr_ = schedule_of(learners.LCNClassifier(), 100), schedule_of(OTR(), 100)
    assert (lcn.epochs, lcn.decay_every, lcn.learning_rate) == (500, 167, 0.03)
    assert (otr_.epochs, otr_.decay_every, otr_.learning_rate) == (500, 167, 0.1)
    assert schedule_of(learners.LCNRegressor(), 10_000).epochs == 30
    assert schedule_of(OTR(epochs=7, decay_every=2), 100) == Schedule(epochs=7, decay_every=2)


def test_without_hidden_layers_the_network_is_linear():
    X, y = problem()
    model = OTR([], epochs=1, random_state=0).fit(X, y)
    assert model.network_.n_hidden == 0
    assert isinstance(model.tree_, otr.ObliqueTree)
    assert Widths().is_satisfied_by([])


def test_hidden_widths_of_augtrees_network_may_be_one_number():
    X, y = problem()
    assert learners.AugTreeClassifier(hidden_layer_sizes=3, mlp_max_iter=2).fit(X, y).network_.n_hidden == 3
    with pytest.raises(ValueError, match=r"'hidden_layer_sizes' .* Got \[3, 0\] instead"):
        learners.AugTreeClassifier(hidden_layer_sizes=[3, 0]).fit(X, y)
