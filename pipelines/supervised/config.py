"""What a fit is asked to do: frozen dataclasses, with the folder that names the fit.

Hydra composes these from `conf/fit/` (see `pipelines/cli`); nothing here knows Hydra. A learner's settings are the
parameters of its estimators in `otr.learners`, under the same names.
"""

from dataclasses import asdict, dataclass, field, fields, replace
from itertools import product
from typing import Any

from pipelines.config import LARGEST_SEED
from pipelines.config.settings import digest, setting_differences
from pipelines.datasets.catalogue import files_of
from pipelines.errors import ConfigError

STAGES = ("tune", "fit", "score")


@dataclass(frozen=True)
class DataConfig:
    """A data set, as `pipelines.datasets.load.load_dataset` names it."""

    name: str


@dataclass(frozen=True)
class LearnerConfig:
    """What every method has.

    Attributes:
        name: of the method, a row of the table.
        learner: which estimators, a key of `LEARNERS`.
        grid: what is tried on the validation part, as scikit-learn's ParameterGrid has it: dicts of setting to values,
            all combinations of each; empty if nothing is tuned.
        tuned_for: `label`, every label its own best combination, or `data`, one for all.
        tuning_seeds: a combination's score is the mean over these, which are not the seeds that are reported.
    """

    name: str
    learner: str
    grid: list[dict[str, list[Any]]] = field(default_factory=list)
    tuned_for: str = "label"
    tuning_seeds: list[int] = field(default_factory=lambda: [1000])


@dataclass(frozen=True)
class LinearConfig(LearnerConfig):
    """`LinearTreeClassifier` and `LinearTreeRegressor`, the trees of depth 0."""

    C: float = 0.1
    alpha: float = 1.0


@dataclass(frozen=True)
class CartConfig(LearnerConfig):
    """`CARTClassifier` and `CARTRegressor`."""

    max_depth: int | None = None
    min_samples_leaf: int = 1


@dataclass(frozen=True)
class HhcartConfig(LearnerConfig):
    """`HHCARTClassifier` and `HHCARTRegressor`."""

    max_depth: int | None = None
    min_samples_leaf: int = 1


@dataclass(frozen=True)
class TaoConfig(LearnerConfig):
    """`TAOClassifier`."""

    max_depth: int | None = None
    penalty: str = "l2"
    surrogate: str = "squared_hinge"
    C: float = 1.0
    max_iter: int = 14
    tol: float = 0.005
    leaf_values: str = "shares"  # or labels


@dataclass(frozen=True)
class AugtreeConfig(LearnerConfig):
    """`AugTreeClassifier` and `AugTreeRegressor` on the first layer of the network that `method=otr` would train."""

    max_depth: int | None = None
    min_samples_leaf: int = 1
    include_inputs: bool = True
    hidden: list[int] = field(default_factory=lambda: [8, 8])


@dataclass(frozen=True)
class ModelTreeConfig(LearnerConfig):
    """`LinearModelTreeRegressor`."""

    max_depth: int = 5


@dataclass(frozen=True)
class LcnConfig(LearnerConfig):
    """`LCNClassifier` and `LCNRegressor`."""

    depth: int = 6
    hidden: int = 0
    drop_connect: float = 0.0
    epochs: int = 30
    batch_size: int = 64
    learning_rate: float = 0.1
    momentum: float = 0.9
    decay_every: int = 10


@dataclass(frozen=True)
class OtrConfig(LearnerConfig):
    """`OTRClassifier` and `OTRRegressor`."""

    hidden: list[int] = field(default_factory=lambda: [8, 8])
    dense: str = "none"  # none, input, all
    negative_slope: float = 0.0
    shared: bool = False
    input_dropout: float = 0.0
    hidden_dropout: float = 0.0
    l1: float = 0.0
    l2: float = 0.0
    drop_below: float = 0.0
    averaging: float = 0.0
    common_epoch: bool = False
    teacher: dict[str, Any] | None = None  # settings of `otr.learners.distillation.Teacher`
    keep: str = "best"  # best: the best epoch by validation score; last
    epochs: int = 30
    batch_size: int = 64
    learning_rate: float = 0.1
    momentum: float = 0.9
    decay_every: int = 10
    max_leaves: int = 1024  # a larger tree is held as activation patterns


LEARNERS: dict[str, type[LearnerConfig]] = {
    "linear": LinearConfig,
    "cart": CartConfig,
    "hhcart": HhcartConfig,
    "tao": TaoConfig,
    "augtree": AugtreeConfig,
    "model_tree": ModelTreeConfig,
    "lcn": LcnConfig,
    "otr": OtrConfig,
}
# Settings younger than committed results, with the value that means "as before": keyed only where they differ from it.
YOUNGER_SETTINGS: dict[str, Any] = {"leaf_values": "shares"}
TUNING = tuple(item.name for item in fields(LearnerConfig))


@dataclass(frozen=True)
class FitConfig:
    """One fit. What is below `results_dir` changes how it is executed, never what comes out."""

    data: DataConfig
    method: LearnerConfig
    seed: int
    results_dir: str
    stages: list[str] | None = None
    keep_trees: bool = True
    n_workers: int | None = None
    seeds_per_process: int = 10
    side_by_side: bool = False  # other jobs share the terminal
    debug: bool = False
    # The fit's folder below results_dir, which the command line works out from all of the above.
    folder: str = field(default="", metadata={"omegaconf_ignore": True})

    def __post_init__(self) -> None:
        if not 0 <= self.seed <= LARGEST_SEED:
            raise ConfigError(f"seed={self.seed} is not between 0 and {LARGEST_SEED}")
        if self.seeds_per_process < 1:
            raise ConfigError(f"seeds_per_process={self.seeds_per_process} is not at least 1")
        if not self.results_dir:
            raise ConfigError("results_dir is empty; give a folder, or leave it out (and OTR_RESULTS_DIR unset)")
        for stage in self.stages or ():
            if stage not in self.all_stages:
                own = ", ".join(self.all_stages)
                raise ConfigError(f"stages: method={self.method.name} has no stage {stage!r}; it has {own}")
        _check_grid(self.method)

    @property
    def all_stages(self) -> tuple[str, ...]:
        """The method's stages, in order."""
        return STAGES if self.method.grid else STAGES[1:]

    @property
    def selected_stages(self) -> tuple[str, ...]:
        """The stages to do, in the method's order."""
        return self.all_stages if self.stages is None else tuple(s for s in self.all_stages if s in self.stages)


def combinations(method: LearnerConfig) -> list[dict[str, Any]]:
    """Return the combinations of settings that the grid asks for, in its order."""
    return [dict(zip(values, chosen, strict=True)) for values in method.grid for chosen in product(*values.values())]


def with_settings(method: LearnerConfig, changes: dict[str, Any]) -> LearnerConfig:
    """Return a method with some settings replaced and nothing to tune."""
    return replace(method, grid=[], **changes)


def learner_settings(method: LearnerConfig) -> dict[str, Any]:
    """Return the settings that the learner itself has."""
    return {key: value for key, value in asdict(method).items() if key not in TUNING}


def tune_settings(config: FitConfig) -> dict[str, Any]:
    """Return what decides the choice of the settings: all but the seed."""
    return {"data": _data_settings(config.data), "method": _keyed(config.method)}


def fit_settings(config: FitConfig) -> dict[str, Any]:
    """Return what decides the trees; how they are tuned is in the input."""
    return {"data": _data_settings(config.data), "seed": config.seed} | {
        "method": {key: value for key, value in _keyed(config.method).items() if key == "learner" or key not in TUNING}
    }


def settings(config: FitConfig) -> dict[str, Any]:
    """Return all the settings that decide what comes out, as plain JSON-able data."""
    return {"data": _data_settings(config.data), "method": _keyed(config.method), "seed": config.seed}


def fit_folder(config: FitConfig, baseline: FitConfig) -> str:
    """Return the fit's folder below `results_dir`: `runs/<data>/<method>/seed-<s>[~<digest>]`.

    `baseline` is what the same data, method and seed give without any other override.
    """
    differences = setting_differences(settings(config), settings(baseline))
    suffix = f"~{digest(differences)[:8]}" if differences else ""
    return f"runs/{config.data.name}/{config.method.name}/seed-{config.seed}{suffix}"


def _keyed(method: LearnerConfig) -> dict[str, Any]:
    """Return a method's settings as they are keyed."""
    return {key: value for key, value in asdict(method).items() if YOUNGER_SETTINGS.get(key, ...) != value}


def _data_settings(data: DataConfig) -> dict[str, Any]:
    """Return the data set's name and the hashes of its files."""
    return {"name": data.name, "git_blobs": [file.git_blob for file in files_of(data.name)]}


def _check_grid(method: LearnerConfig) -> None:
    if method.tuned_for not in ("label", "data"):
        raise ConfigError(f"method.tuned_for={method.tuned_for}: use label or data")
    known = learner_settings(method)
    if known.get("keep", "best") not in ("best", "last"):
        raise ConfigError(f"method.keep={known['keep']}: use best or last")
    for values in method.grid:
        for key, tried in values.items():
            if key not in known:
                raise ConfigError(f"method.grid: {method.learner} has no setting {key!r}; it has {', '.join(known)}")
            if not isinstance(tried, list) or not tried:
                raise ConfigError(f"method.grid: {key} needs a list of values to try, but is {tried!r}")
    if method.grid and not method.tuning_seeds:
        raise ConfigError("method.tuning_seeds is empty; give at least one seed, or no grid")
