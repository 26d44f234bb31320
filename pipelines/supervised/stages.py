"""The stages of a fit: tune (where there is a grid), fit, score."""

from collections.abc import Mapping
from pathlib import Path

from pipelines.engine.stage import Stage
from pipelines.supervised.config import FitConfig, fit_settings, settings, tune_settings


def stages_of(config: FitConfig) -> tuple[Stage, ...]:
    """Return the stages that are asked for, in order."""
    tuned = ("tune",) if config.method.grid else ()
    every = {
        "tune": Stage("tune", TUNE_VERSION, (), tune_settings, _tune),
        "fit": Stage("fit", FIT_VERSION, tuned, fit_settings, _fit, is_transient=True),
        "score": Stage("score", SCORE_VERSION, ("fit",), settings, _score),
    }
    return tuple(every[name] for name in config.selected_stages)


# Raised when the same settings would give something else. Here, because the stages' own modules load torch and
# scikit-learn, which take seconds.
TUNE_VERSION = FIT_VERSION = SCORE_VERSION = 1


def _tune(inputs: Mapping[str, Path], config: FitConfig, out: Path) -> None:
    from pipelines.supervised.tune import tune

    tune(inputs, config, out)


def _fit(inputs: Mapping[str, Path], config: FitConfig, out: Path) -> None:
    from pipelines.supervised.fit import fit

    fit(inputs, config, out)


def _score(inputs: Mapping[str, Path], config: FitConfig, out: Path) -> None:
    from pipelines.supervised.score import score_trees

    score_trees(inputs, config, out)
