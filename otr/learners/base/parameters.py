"""The constraints of parameters, declared once for every learner in scikit-learn's terms.

An estimator's `_parameter_constraints` are checked in `fit`, those of a settings dataclass when it is made. The error,
a ValueError and a TypeError, names the parameter, its value and what it may be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.utils._param_validation import Interval, StrOptions, validate_parameter_constraints

Constraints = dict[str, list[Any]]

AT_LEAST_0 = Interval(Integral, 0, None, closed="left")
AT_LEAST_1 = Interval(Integral, 1, None, closed="left")
NOT_NEGATIVE = Interval(Real, 0, None, closed="left")
POSITIVE = Interval(Real, 0, None, closed="neither")
SHARE = Interval(Real, 0, 1, closed="both")
BELOW_1 = Interval(Real, 0, 1, closed="left")
SEED = [AT_LEAST_0, np.random.RandomState, None]
STANDARDIZE = ["boolean", StrOptions({"auto"})]
CLASS_WEIGHT = [dict, StrOptions({"balanced"}), None]


class Widths(Interval):  # type: ignore[misc]
    """Widths of layers: a sequence of whole numbers from 1 on, which may be empty."""

    def __init__(self) -> None:
        super().__init__(Integral, 1, None, closed="left")

    def is_satisfied_by(self, val: Any) -> bool:
        """Return whether `val` is a sequence and each item is in the range."""
        is_sequence = isinstance(val, Sequence | np.ndarray) and not isinstance(val, str)
        return is_sequence and all(Interval.is_satisfied_by(self, width) for width in val)

    def __str__(self) -> str:
        return f"a sequence, each item {super().__str__()}"


class Settings:
    """Base of the frozen dataclasses whose fields are declared as an estimator's parameters are."""

    _parameter_constraints: ClassVar[Constraints]

    def __post_init__(self) -> None:
        """Raise ValueError, or TypeError, that names a field, its value and what it may be."""
        validate_parameter_constraints(self._parameter_constraints, vars(self), type(self).__name__)


def some_of(owner: type[BaseEstimator] | type[Settings], *names: str) -> Constraints:
    """Return what an estimator or a settings dataclass declares of these parameters."""
    return {name: owner._parameter_constraints[name] for name in names}


def parameters_of(estimator: BaseEstimator, settings: type[Settings]) -> dict[str, Any]:
    """Return the estimator's parameters that have a field in the settings dataclass."""
    known = estimator.get_params(deep=False)
    return {field.name: known[field.name] for field in fields(settings) if field.name in known}  # type: ignore[arg-type]
