"""The method of a run: a file of conf/method. Its stages are in `pipelines/config/methods.py`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MethodConfig:
    """The method's name; its stages are its row in `pipelines/config/methods.py`."""

    name: str


@dataclass(frozen=True)
class ViperConfig(MethodConfig):
    """VIPER: CART on rows drawn by the oracle's weights; the names are those of `otr.control.CartFit`."""

    max_samples: int
    min_samples_leaf: int


@dataclass(frozen=True)
class LmViperConfig(MethodConfig):
    """LM-VIPER: a linear model in every leaf; the names are those of `otr.control.LinearModelTreeFit`."""

    max_samples: int
    min_samples_leaf: int
    alpha: float


@dataclass(frozen=True)
class AugTreeConfig(MethodConfig):
    """AugTree: tests on the oracle's hidden units; the names are those of `otr.control.AugTreeFit`."""

    features: str
    leaves: str
    max_patterns: int
    weighted: bool
    criterion: str
    max_samples: int
    min_samples_leaf: int


@dataclass(frozen=True)
class NdpsConfig(MethodConfig):
    """NDPS: a soft tree fitted to the oracle, hardened and refitted; the names are those of `otr.control.NdpsImitator`.

    Attributes:
        max_samples: rows drawn for a fit.
        n_updates, n_updates_next: Adam's updates of the first fit, and of those that go on from the last round's tree.
        batch_size, learning_rate, beta_first, beta_last, ridge: see `otr.control.NdpsSettings`.
    """

    max_samples: int
    n_updates: int
    n_updates_next: int
    batch_size: int
    learning_rate: float
    beta_first: float
    beta_last: float
    ridge: float


@dataclass(frozen=True)
class SoftConfig(MethodConfig):
    """A method whose actor is a soft tree, trained by policy gradient.

    Attributes:
        beta_first, beta_last: how hard its tests are at first and at last, growing geometrically.
        anneal_until: the fraction of the steps at which beta has reached its last value.
        learning_rate_end: what is left of the algorithm's learning rate at the end, a fraction; it falls linearly.
    """

    beta_first: float
    beta_last: float
    anneal_until: float
    learning_rate_end: float


@dataclass(frozen=True)
class SdtConfig(SoftConfig):
    """A soft decision tree (Silva et al. 2020), with constant or affine leaves."""

    leaves: str


@dataclass(frozen=True)
class CdtConfig(SoftConfig):
    """A cascading decision tree (Ding et al. 2020) with `n_features` features between its two trees."""

    n_features: int


@dataclass(frozen=True)
class PiPrlConfig(SoftConfig):
    """pi-PRL (Qiu & Zhu 2022): `discretise_at` is the fraction of the steps at which the structure is chosen."""

    structure_penalty: float
    discretise_at: float


@dataclass(frozen=True)
class ProgramConfig(MethodConfig):
    """A program that somebody wrote: `program` is a file, or a name under conf/program."""

    program: str


@dataclass(frozen=True)
class PidConfig(MethodConfig):
    """A PID policy, whose actor gives the gains (Orfanos 2023, section 4.1.1).

    Attributes:
        goal: the state to come to rest in, one number a component.
        n_history: states before the present one that the policy knows.
        l1: weight of the sum of the gains' absolute output weights in the actor's loss.
        first_layer_scale: of the initial weights and biases of the first hidden layer, in units of torch's own. The
            penalty is on the output weights alone, so gains vary more cheaply behind large first-layer weights.
        zero_below: output weights smaller than this are set to zero before every evaluation: the penalty, taken in
            steps of the learning rate's size, leaves them swinging about it.
    """

    goal: list[float]
    n_history: int
    l1: float
    first_layer_scale: float
    zero_below: float


METHOD_CONFIGS: dict[str, type[MethodConfig]] = {
    "otr": MethodConfig,
    "linear": MethodConfig,
    "pid": PidConfig,
    "viper": ViperConfig,
    "lm_viper": LmViperConfig,
    "augtree": AugTreeConfig,
    "ndps": NdpsConfig,
    "sdt": SdtConfig,
    "cdt": CdtConfig,
    "pi_prl": PiPrlConfig,
    "program": ProgramConfig,
}
