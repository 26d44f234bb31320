"""What a fit is asked to do: frozen dataclasses, with the folder that names the fit.

Hydra composes these from `conf/fit/` (see `pipelines/cli`); nothing here knows Hydra. A learner's settings are the
parameters of its estimators in `otr.learners`, under the same names.
"""

from dataclasses import asdict, dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pipelines.config.setting import (
    DERIVED,
    EXECUTION,
    AsBefore,
    Count,
    Folder,
    FreeText,
    NotNegative,
    OneOf,
    Positive,
    Range,
    Seed,
    Share,
    Width,
    check_setting,
    check_settings,
    keyed_settings,
)
from pipelines.datasets.catalogue import files_of, git_blob_hash
from pipelines.datasets.load import check_split
from pipelines.engine.digests import differences_suffix
from pipelines.errors import ConfigError

STAGES = ("tune", "fit", "teacher", "score")
TABLE = "table"  # the data set's name of a table whose file is not named yet
BelowOne = Annotated[float, Range(0, 1, open=True)]


@dataclass(frozen=True)
class DataConfig:
    """A data set, as `load_dataset` has it, or with a file as `load_table` has it (`pipelines.datasets`)."""

    name: FreeText
    # The seed that redraws the parts, of molecules whole scaffolds together; None for LCN's parts
    split: Annotated[int | None, Range(0), AsBefore(None)] = None
    file: Annotated[FreeText | None, EXECUTION] = None  # of a table, whose content is keyed
    target: Annotated[FreeText | None, AsBefore(None)] = None
    task: Annotated[str | None, OneOf("classification", "regression", "counts"), AsBefore(None)] = None
    drop: Annotated[list[FreeText], AsBefore([])] = field(default_factory=list)


@dataclass(frozen=True)
class LearnerConfig:
    """The settings of every method."""

    name: FreeText  # of the method, a row of the table
    learner: FreeText  # which estimators, a key of `LEARNERS`
    # What is tried, as scikit-learn's ParameterGrid has it: dicts of setting to values, all
    # combinations of each; empty if nothing is tuned
    grid: list[dict[str, list[Any]]] = field(default_factory=list)
    # On what: `valid`, the validation part, or `folds`, a cross-validation of whole scaffolds inside train and valid
    tuned_on: Annotated[str, OneOf("valid", "folds"), AsBefore("valid")] = "valid"
    # `label`, every label its own best combination, or `data`, one for all
    tuned_for: Annotated[str, OneOf("label", "data")] = "label"
    # A combination's score is the mean over these, which are not the seeds that are reported
    tuning_seeds: list[Seed] = field(default_factory=lambda: [1000])


@dataclass(frozen=True)
class ClassifierConfig(LearnerConfig):
    """The settings of methods that classify."""

    class_weight: Annotated[str | None, OneOf("balanced"), AsBefore(None)] = (
        None  # balanced: each class counts the same
    )


@dataclass(frozen=True)
class TaughtConfig(ClassifierConfig):
    """The settings of methods other than OTR that learn labels, or the probabilities of a teacher."""

    teacher: Annotated[dict[str, Any] | None, AsBefore(None)] = None  # as of `OtrConfig`


@dataclass(frozen=True)
class LinearConfig(TaughtConfig):
    """`LinearTreeClassifier` and `LinearTreeRegressor`, of depth 0 by default."""

    C: Positive = 0.1  # of logistic regression
    alpha: NotNegative = 1.0  # of ridge regression, on standardised targets
    max_depth: Annotated[int, Range(0), AsBefore(0)] = 0


@dataclass(frozen=True)
class CartConfig(TaughtConfig):
    """`CARTClassifier` and `CARTRegressor`."""

    max_depth: Count | None = None
    min_samples_leaf: Count = 1


@dataclass(frozen=True)
class HhcartConfig(ClassifierConfig):
    """`HHCARTClassifier` and `HHCARTRegressor`."""

    max_depth: Annotated[int | None, Range(0)] = None
    min_samples_leaf: Count = 1


@dataclass(frozen=True)
class TaoConfig(TaughtConfig):
    """`TAOClassifier`."""

    max_depth: Count | None = None
    penalty: Annotated[str, OneOf("l1", "l2")] = "l2"
    surrogate: Annotated[str, OneOf("squared_hinge", "logistic")] = "squared_hinge"
    C: Positive = 1.0
    max_iter: Annotated[int, Range(0)] = 14
    tol: Annotated[float, Range()] = 0.005
    # Shares of the training rows rank better than labels
    leaf_values: Annotated[str, OneOf("shares", "labels"), AsBefore("shares")] = "shares"


@dataclass(frozen=True)
class FirstLayerTreeConfig(ClassifierConfig):
    """`AugTreeClassifier` and `AugTreeRegressor` on the first layer of the network that `method=otr` would train."""

    max_depth: Count | None = None
    min_samples_leaf: Count = 1
    include_inputs: bool = True
    hidden: list[Width] = field(default_factory=lambda: [8, 8])  # of the network


@dataclass(frozen=True)
class LcnConfig(ClassifierConfig):
    """`LCNClassifier` and `LCNRegressor`."""

    depth: Count = 6
    hidden: Annotated[int, Range(0)] = 0  # width of g's hidden layer; 0 for a linear g
    drop_connect: BelowOne = 0.0
    epochs: Count = 30
    batch_size: Count = 64
    learning_rate: Positive = 0.1  # times 0.1 every `decay_every` epochs
    momentum: Share = 0.9
    decay_every: Count = 10


@dataclass(frozen=True)
class OtrConfig(ClassifierConfig):
    """`OTRClassifier` and `OTRRegressor`."""

    hidden: list[Width] = field(default_factory=lambda: [8, 8])
    # input: every layer reads the inputs; all: and every layer before it
    dense: Annotated[str, OneOf("none", "input", "all")] = "none"
    negative_slope: BelowOne = 0.0
    shared: bool = False  # whether the labels share their hidden layers in training
    input_dropout: BelowOne = 0.0
    hidden_dropout: BelowOne = 0.0
    l1: NotNegative = 0.0
    l2: NotNegative = 0.0
    drop_below: NotNegative = 0.0  # weights smaller than this are zero after training
    averaging: BelowOne = 0.0  # of the weights, decay of the moving average by step
    common_epoch: bool = False  # whether one epoch is kept for all labels
    teacher: dict[str, Any] | None = None  # settings of `otr.learners.distillation.Teacher`
    keep: Annotated[str, OneOf("best", "last")] = "best"  # the best epoch by validation score
    epochs: Count = 30
    batch_size: Count = 64
    learning_rate: Positive = 0.1  # times 0.1 every `decay_every` epochs
    momentum: Share = 0.9
    decay_every: Count = 10
    loss: Annotated[str, OneOf("squared_error", "poisson"), AsBefore("squared_error")] = (
        "squared_error"  # of numbers; poisson is for counts
    )
    max_leaves: Count = 1024  # a larger tree is held as activation patterns


LEARNERS: dict[str, type[LearnerConfig]] = {
    "linear": LinearConfig,
    "cart": CartConfig,
    "hhcart": HhcartConfig,
    "tao": TaoConfig,
    "augtree": FirstLayerTreeConfig,
    "lcn": LcnConfig,
    "otr": OtrConfig,
}
TUNING = tuple(item.name for item in fields(LearnerConfig))
TUNING_ALONE = ("tuned_on", "tuned_for", "tuning_seeds")  # which say how, where there is a grid


@dataclass(frozen=True)
class FitConfig:
    """One fit."""

    data: DataConfig
    method: LearnerConfig
    seed: Seed
    results_dir: Folder
    stages: Annotated[list[FreeText] | None, EXECUTION] = None  # the stages to do; None for all
    keep_trees: Annotated[bool, EXECUTION] = True  # whether the trees stay when the fit is scored
    n_workers: Annotated[Count | None, EXECUTION] = None
    seeds_per_process: Annotated[Count, EXECUTION] = 10
    side_by_side: Annotated[bool, EXECUTION] = False  # whether other jobs share the terminal
    debug: Annotated[bool, EXECUTION] = False
    # The fit's folder below `results_dir`, which the command line works out from all other settings
    folder: Annotated[FreeText, DERIVED] = field(default="", metadata={"omegaconf_ignore": True})

    summary_schema: ClassVar[str] = "otr/fit-summary/1"

    def __post_init__(self) -> None:
        check_settings(self)
        if self.stages == []:
            raise ConfigError("stages=[] does nothing; name stages, as stages=[tune,fit], or leave it out for all")
        for stage in self.stages or ():
            if stage not in self.all_stages:
                own = ", ".join(self.all_stages)
                raise ConfigError(f"stages: method={self.method.name} has no stage {stage!r}; it has {own}")
        _check_grid(self.method)
        if _is_taught(self.method) and self.method.grid and self.method.tuned_for == "label":
            raise ConfigError("method.tuned_for=label with a teacher, who teaches all labels at once; choose data")
        if self.data.file is None:
            _check_known(self.data)

    @property
    def all_stages(self) -> tuple[str, ...]:
        """The method's stages, in order."""
        left_out = {"tune"} if not self.method.grid else set()
        left_out |= {"teacher"} if not _is_taught(self.method) else set()
        return tuple(stage for stage in STAGES if stage not in left_out)

    @property
    def selected_stages(self) -> tuple[str, ...]:
        """The stages to do, in the method's order."""
        return self.all_stages if self.stages is None else tuple(s for s in self.all_stages if s in self.stages)

    @property
    def line_start(self) -> str:
        """What printed lines begin with where other jobs share the terminal."""
        return f"{self.data.name} {self.method.name}: " if self.side_by_side else ""

    def settings(self) -> dict[str, Any]:
        """Return all the settings that decide what comes out, as plain JSON-able data."""
        path = self.data.file
        files = [file.git_blob for file in files_of(self.data.name)] if path is None else [_git_blob(path)]
        return keyed_settings(self) | {"data": {**keyed_settings(self.data), "git_blobs": files}}


def _check_known(data: DataConfig) -> None:
    """Raise ConfigError where a data set that is no table has settings of one, or cannot be split."""
    if data.name == TABLE:
        return  # a fit's usual settings; its reader asks for the file
    given = next((key for key in ("target", "task", "drop") if getattr(data, key)), None)
    if given:
        value = getattr(data, given)
        raise ConfigError(f"{given}={value}: {data.name} has its labels; a {given} is for data=FILE.csv")
    check_split(data.name, data.split)


def _git_blob(path: str) -> str:
    """Return the hash of a table's content; "" where it cannot be read, for which its reader raises the error."""
    try:
        return git_blob_hash(Path(path).read_bytes())
    except OSError:
        return ""


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
    return {key: value for key, value in config.settings().items() if key != "seed"}


def fit_settings(config: FitConfig) -> dict[str, Any]:
    """Return what decides the trees; how they are tuned is in the input."""
    method = {
        key: value for key, value in keyed_settings(config.method).items() if key == "learner" or key not in TUNING
    }
    settings = config.settings()
    return {"data": settings["data"], "seed": settings["seed"], "method": method}


def fit_folder(config: FitConfig, differences: dict[str, list[Any]]) -> str:
    """Return the fit's folder below `results_dir`: `runs/<data>/<method>[/split-<k>]/seed-<s>[~<digest>]`.

    `differences` are {setting: [value, usual one]} of what a command sets that no other part of the name says.
    """
    split = "" if config.data.split is None else f"/split-{config.data.split}"
    return f"runs/{config.data.name}/{config.method.name}{split}/seed-{config.seed}{differences_suffix(differences)}"


def _is_taught(method: LearnerConfig) -> bool:
    """Return whether a method's networks or trees learn from a teacher, or may be chosen to."""
    return getattr(method, "teacher", None) is not None or any("teacher" in values for values in method.grid)


def _check_grid(method: LearnerConfig) -> None:
    known = learner_settings(method)
    for values in method.grid:
        for key, tried in values.items():
            if key not in known:
                raise ConfigError(f"method.grid: {method.learner} has no setting {key!r}; it has {', '.join(known)}")
            if not isinstance(tried, list) or not tried:
                raise ConfigError(f"method.grid: {key} needs a list of values to try, but is {tried!r}")
            for value in tried:
                check_setting(type(method), key, value, f"method.grid: {key}")
    if method.grid and not method.tuning_seeds:
        raise ConfigError("method.tuning_seeds is empty; give at least one seed, or no grid")
